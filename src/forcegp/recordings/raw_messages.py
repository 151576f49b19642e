"""The messages of one topic as bytes, many at a time.

`rosbags` gives them one by one. An MCAP file whose chunks follow each other in time, as recorders write them, is read
chunk by chunk instead, which takes a fraction of the time; every other bag goes the general way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import Any

import numpy as np

from forcegp.errors import FileFormatError
from forcegp.recordings.mcap_chunks import RECORD, Chunk, mcap_chunks

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
