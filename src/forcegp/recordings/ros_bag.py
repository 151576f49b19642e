"""ROS 1 bags, ROS 2 bags and bare .mcap and .db3 files, read with `rosbags` (extra "logs"), without ROS."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import override

from forcegp.errors import FileFormatError, InvalidInput, MissingExtra
from forcegp.recordings.message_layout import MessageLayout, message_layout
from forcegp.recordings.raw_messages import RawMessages, mcap_chunks, topic_messages
from forcegp.recordings.source import Columns, Source, reading, require_plausible_size

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
            self._check_chunks(reader)
            yield reader

    def _check_chunks(self, reader: Any) -> None:
        """Compare what compressed chunks of .mcap files claim to hold with their size."""
        for chunk in mcap_chunks(reader) or ():
            require_plausible_size(self.path, "a chunk", chunk.expanded, chunk.stored)

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
        columns, topic = self._topics[next(iter(topics))], next(iter(topics))
        stamp = f"{topic}:{STAMP}"
        return stamp if stamp in columns else f"{topic}:{LOG_TIME}"

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
