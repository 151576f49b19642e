"""The messages of one topic as bytes, many at a time.

`rosbags` gives them one by one. An MCAP file whose chunks follow each other in time, as recorders write them, is read
chunk by chunk instead, which takes a fraction of the time; every other bag goes the general way. Only `mcap_chunks`
uses what `rosbags` does not promise to keep.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import Any, BinaryIO

import numpy as np

from forcegp.errors import FileFormatError

RECORD = struct.Struct("<BQ")  # opcode, length
CHUNK = 0x06
CHECKSUM_AT = RECORD.size + 24  # after the times of the first and last message and the size when expanded, 8 bytes each


@dataclass(frozen=True)
class Chunk:
    """A chunk: log times of its first and last message [ns], its size in bytes as stored and when expanded."""

    begin: int
    end: int
    stored: int
    expanded: int
    counts: Mapping[int, int]
    """Messages by channel."""
    topics: Mapping[int, str]
    """Topic by channel, of the whole file."""
    records: Callable[[], bytes]
    """Reads and expands the records; compares size and checksum."""


def mcap_chunks(reader: Any) -> list[Chunk] | None:
    """The chunks of the MCAP files of a bag in the order in which they are stored.

    `reader` is an open `rosbags.highlevel.AnyReader`. None for what is no bag of MCAP files with chunks, and where
    `rosbags` differs inside from the version that this function was written for (0.11): its public `reader.messages`
    gives the same messages, in several times the time.
    """
    try:
        from rosbags.rosbag2.storage_mcap import decompress

        (bag,) = reader.readers
        storage = bag.storage
        if getattr(storage.metadata, "compression_mode", None) == "message":
            return None
        found = []
        for store in getattr(storage, "storages", [storage]):  # a directory has several, a file is one
            topics = {connection.id: connection.topic for connection in store.connections}
            # where the offset no longer points to the chunk, everything read there would be garbage
            if not all(_begins_at(chunk, store.bio) for chunk in store.chunks[-1:]):
                return None
            found += [_chunk(chunk, topics, store.bio, str(store.path), decompress) for chunk in store.chunks]
        return found or None
    except (ImportError, AttributeError, TypeError, ValueError):
        return None


def _chunk(
    info: Any, topics: Mapping[int, str], file: BinaryIO, path: str, decompress: Callable[[bytes, str, int, int], bytes]
) -> Chunk:
    offset, compression = info.chunk_start_offset, info.compression
    stored, expanded = info.compressed_size, info.uncompressed_size

    def records() -> bytes:
        # opcode, length, two times, size, checksum (u32), compression (u32 and text), length of the records (u64)
        file.seek(offset + CHECKSUM_AT)
        (checksum,) = struct.unpack("<I", file.read(4))
        file.seek(offset + CHECKSUM_AT + 4 + 4 + len(compression) + 8)
        data = file.read(stored)
        if len(data) < stored:
            raise FileFormatError(f"{path} ends within a chunk; copy it again.")
        return decompress(data, compression, expanded, checksum)

    return Chunk(info.message_start_time, info.message_end_time, stored, expanded, info.channel_count, topics, records)


def _begins_at(info: Any, file: BinaryIO) -> bool:
    file.seek(info.chunk_start_offset)
    return file.read(1) == bytes([CHUNK])


MESSAGE = 0x05
"""Opcode of a message in MCAP: channel u16, sequence u32, log time u64, publish time u64, then its bytes."""

BEFORE_MESSAGE = 22


@dataclass(frozen=True)
class RawMessages:
    """Messages in one buffer (bytes,), in the order of time: where each begins, how long it is, its log time in ns."""

    buffer: np.ndarray
    begins: np.ndarray
    lengths: np.ndarray
    stamps: np.ndarray

    def table(self, rows: np.ndarray, length: int) -> np.ndarray:
        """(rows, length) bytes of these messages, all of that length."""
        return np.lib.stride_tricks.sliding_window_view(self.buffer, length)[self.begins[rows]]


def topic_messages(reader: Any, connections: Sequence[Any], rows: int) -> Iterator[RawMessages]:
    """The messages of these connections of a `rosbags` reader, at most `rows` at a time."""
    chunks = _ordered_chunks(reader)
    if chunks is None:
        messages = reader.messages(connections)
        while batch := list(islice(messages, rows)):
            raw = [bytes(data) for _, _, data in batch]
            lengths = np.fromiter(map(len, raw), np.int64, len(raw))
            stamps = np.fromiter((stamp for _, stamp, _ in batch), np.int64, len(batch))
            yield RawMessages(np.frombuffer(b"".join(raw), np.uint8), np.cumsum(lengths) - lengths, lengths, stamps)
        return
    wanted = {connection.topic for connection in connections}
    for chunk in chunks:
        channels = [channel for channel, topic in chunk.topics.items() if topic in wanted]
        if any(chunk.counts.get(channel, 0) for channel in channels):
            yield from _of_chunk(chunk.records(), channels, rows)


def _ordered_chunks(reader: Any) -> list[Chunk] | None:
    """The chunks of a bag if they do not overlap in time."""
    chunks = mcap_chunks(reader)
    if chunks is None or any(one.end > other.begin for one, other in pairwise(chunks)):
        return None
    return chunks


def _of_chunk(records: bytes, channels: Sequence[int], rows: int) -> Iterator[RawMessages]:
    begins, ends = [], []
    position, size = 0, len(records)
    while position < size:
        code, length = RECORD.unpack_from(records, position)
        position += RECORD.size
        if code == MESSAGE:
            begins.append(position)
            ends.append(position + length)
        position += length
    if position != size or (ends and max(ends) > size):
        raise FileFormatError("a record reaches beyond its chunk")
    buffer = np.frombuffer(records, np.uint8)
    begin, end = np.asarray(begins, np.int64), np.asarray(ends, np.int64)
    if (end - begin < BEFORE_MESSAGE).any():
        raise FileFormatError("a message is shorter than its header")
    heads = np.lib.stride_tricks.sliding_window_view(buffer, BEFORE_MESSAGE)[begin]
    channel = np.ascontiguousarray(heads[:, :2]).view("<u2")[:, 0]
    stamp = np.ascontiguousarray(heads[:, 6:14]).view("<i8")[:, 0]
    own = np.flatnonzero(np.isin(channel, channels))
    own = own[np.argsort(stamp[own], kind="stable")]
    for start in range(0, len(own), rows):
        some = own[start : start + rows]
        first = begin[some] + BEFORE_MESSAGE
        yield RawMessages(buffer, first, end[some] - first, stamp[some])
