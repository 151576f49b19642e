"""The chunks of MCAP files, read in one piece: the only place that uses what `rosbags` does not promise to keep."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

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
