"""ROS 1 bags, ROS 2 bags and bare .mcap and .db3 files, read with `rosbags` (extra "logs"), without ROS.

`rosbags` gives messages one by one. An MCAP file whose chunks follow each other in time, as recorders write them, is
read chunk by chunk instead, which takes a fraction of the time; every other bag goes the general way. Only
`mcap_chunks` uses what `rosbags` does not promise to keep.
"""

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from typing_extensions import override

from forcegp.errors import FileFormatError, InvalidInput, MissingExtra
from forcegp.recordings.message_layout import MessageLayout, message_layout
from forcegp.recordings.source import Columns, Source, reading, require_plausible_size

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


LOG_TIME = "log_time"
STAMP = "header.stamp"
LOOKED_AT = 100
"""Messages of each topic that decide which columns there are: publishers may share a topic."""

MOST_LAYOUTS = 1000


class RosBag(Source):
    """The numeric fields of all messages, called `TOPIC:field`.

    Fields are `/wrench:wrench.force.x`, `/commands:data[3]`; those of a sensor_msgs/JointState go by joint name,
    `/joint_states:position.elbow`. Times are `TOPIC:header.stamp` (when it was measured) and `TOPIC:log_time` (when the
    recorder got it), in ns. One table is one topic, with a row for every message that has all columns asked for.

    Raises MissingExtra without `rosbags`.
    """

    row_word = "message"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._left_out = 0
        self.ros1 = path.suffix.lower() == ".bag"
        if not self.columns():
            raise FileFormatError(f"{path} holds no messages with numbers.")

    @contextmanager
    def _open(self) -> Iterator[Any]:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise MissingExtra("reading bags needs rosbags: pip install 'forcegp[logs]'") from error

        known = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.LATEST)
        if self.path.is_dir() and not (self.path / "metadata.yaml").is_file():
            raise FileFormatError(
                f"{self.path} has no metadata.yaml; give a whole ROS 2 bag, or its .mcap or .db3 file."
            )
        # Exception: rosbags meets damaged files with whatever its parsers, sqlite, zstd and lz4 raise
        with reading(self.path, "a bag", Exception), AnyReader([self.path], default_typestore=known) as reader:
            for chunk in mcap_chunks(reader) or ():
                require_plausible_size(self.path, "a chunk", chunk.expanded, chunk.stored)
            yield reader

    @cached_property
    def _topics(self) -> Mapping[str, tuple[str, ...]]:
        """Topic -> its columns."""
        found: dict[str, dict[str, None]] = {}
        with self._open() as reader:
            for connection in reader.connections:
                names = found.setdefault(connection.topic, {})
                for _, _, raw in islice(reader.messages([connection]), LOOKED_AT):
                    layout = message_layout(bytes(raw), connection.msgtype, reader.typestore.fielddefs, ros1=self.ros1)
                    names |= dict.fromkeys(layout.places)
                    names[LOG_TIME] = None
        return {topic: tuple(f"{topic}:{name}" for name in names) for topic, names in found.items()}

    @override
    def columns(self) -> tuple[str, ...]:
        return tuple(name for names in self._topics.values() for name in names)

    @property
    @override
    def vectors(self) -> Mapping[str, tuple[str, ...]]:
        """`TOPIC:position` for all joints of a JointState, in the order of the messages."""
        found = dict(super().vectors)
        for name in self.columns():
            for kind in ("position", "velocity", "effort"):
                topic, found_kind, joint = name.partition(f":{kind}.")
                if found_kind and joint:
                    found[f"{topic}:{kind}"] = (*found.get(f"{topic}:{kind}", ()), name)
        return found

    @override
    def time_beside(self, names: Sequence[str]) -> str | None:
        topics = {self._topic_of(name) for name in names}
        if len(topics) != 1:
            return None
        [topic] = topics
        stamp = f"{topic}:{STAMP}"
        return stamp if stamp in self._topics[topic] else f"{topic}:{LOG_TIME}"

    @override
    def files(self) -> tuple[Path, ...]:
        if self.path.is_file():
            return (self.path,)
        return tuple(sorted(file for file in self.path.iterdir() if file.is_file()))

    @override
    def notes(self) -> tuple[str, ...]:
        if not self._left_out:
            return ()
        return (f"messages left out because they lack a column, as those of another publisher do: {self._left_out}",)

    def _topic_of(self, name: str) -> str:
        return next(topic for topic, names in self._topics.items() if name in names)

    @override
    def chunks(self, names: Sequence[str], rows: int) -> Iterator[Columns]:
        self.require(names)
        topics = sorted({self._topic_of(name) for name in names})
        if len(topics) != 1:
            raise InvalidInput(
                f"{self.path}: the columns come from the topics {', '.join(topics)}, whose messages have times of "
                "their own; map columns of one topic, or record them in one message."
            )
        wanted = {name: name[len(topics[0]) + 1 :] for name in names}
        self._left_out = 0
        with self._open() as reader:
            connections = [item for item in reader.connections if item.topic == topics[0]]
            kinds = sorted({item.msgtype for item in connections})
            if len(kinds) > 1:
                raise FileFormatError(f"{self.path}: topic {topics[0]} has messages of several types: {kinds}.")
            batches = _Batches(kinds[0], reader.typestore.fielddefs, wanted, ros1=self.ros1)
            for messages in topic_messages(reader, connections, rows):
                columns, kept = batches.columns(messages)
                self._left_out += len(messages.stamps) - kept
                if kept:
                    yield columns


class _Batches:
    """Messages of one topic to columns, all of equal layout at once."""

    def __init__(self, kind: str, types: Mapping[str, Any], wanted: Mapping[str, str], *, ros1: bool) -> None:
        self.kind, self.types, self.ros1 = kind, types, ros1
        self.wanted = wanted
        self.fields = {name: own for name, own in wanted.items() if own != LOG_TIME}
        self.layouts: dict[int, list[MessageLayout]] = {}

    def columns(self, messages: RawMessages) -> tuple[Columns, int]:
        """The columns of the messages that have them all, and how many these are."""
        parts: list[tuple[np.ndarray, Columns]] = []
        for length in np.unique(messages.lengths):
            rows = np.flatnonzero(messages.lengths == length)
            parts.extend(self._of_one_length(messages.table(rows, int(length)), rows))
        if not parts:
            return {}, 0
        rows = np.concatenate([part[0] for part in parts])
        order = np.argsort(rows)
        columns: Columns = {}
        for name, own in self.wanted.items():
            joined = messages.stamps[rows] if own == LOG_TIME else np.concatenate([part[1][name] for part in parts])
            columns[name] = joined[order]
        return columns, len(rows)

    def _of_one_length(self, messages: np.ndarray, rows: np.ndarray) -> Iterator[tuple[np.ndarray, Columns]]:
        known = self.layouts.setdefault(messages.shape[1], [])
        tried = 0
        while len(rows):
            if tried == len(known):
                if tried >= MOST_LAYOUTS:
                    raise FileFormatError(f"messages of {self.kind} have more than {MOST_LAYOUTS} layouts.")
                known.append(message_layout(messages[0].tobytes(), self.kind, self.types, ros1=self.ros1))
            layout = known[tried]
            tried += 1
            fits = layout.fits(messages)
            if fits.any() and all(own in layout.places for own in self.fields.values()):
                yield rows[fits], layout.columns(messages[fits] if not fits.all() else messages, self.fields)
            rows, messages = rows[~fits], messages[~fits]
