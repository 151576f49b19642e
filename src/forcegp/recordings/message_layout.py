"""Where the numbers of a ROS message lie, so that many messages of equal layout are read at once.

ROS 2 messages are CDR (OMG XTypes 1.3, 7.4: a header of four bytes, then values aligned to their own size, counted from
after that header); ROS 1 messages are the same without header, alignment and zero bytes at the end of texts.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from forcegp.errors import FileFormatError
from forcegp.recordings.source import LONGEST_VECTOR, Columns

JOINT_STATE = "sensor_msgs/msg/JointState"
TIME = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
NUMBERS = {
    **{"bool": "u1", "byte": "u1", "octet": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2"},
    **{"uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"},
}
NANOSECONDS = 10**9
DEEPEST = 32


@dataclass
class MessageLayout:
    """The layout of one message, and of all whose fixed bytes are the same.

    `places` maps columns to (offset, type); type "stamp" is seconds and nanoseconds, read as nanoseconds. `fixed` lists
    the offsets of the bytes that decide the layout: lengths, and the names of joints.
    """

    template: bytes
    places: dict[str, tuple[int, str]]
    fixed: np.ndarray

    def fits(self, messages: np.ndarray) -> np.ndarray:
        """Which of these messages (rows, length), all as long as the template, have this layout."""
        own = np.frombuffer(self.template, np.uint8)[self.fixed]
        return (messages[:, self.fixed] == own).all(axis=1)

    def columns(self, messages: np.ndarray, names: Mapping[str, str]) -> Columns:
        """Columns of these messages (rows, length): name of a column -> its name in `places`."""
        found: Columns = {}
        for name, own in names.items():
            offset, kind = self.places[own]
            if kind[1:] == "stamp":
                seconds = _values(messages, offset, kind[0] + "i4").astype(np.int64)
                found[name] = seconds * NANOSECONDS + _values(messages, offset + 4, kind[0] + "u4")
            else:
                values = _values(messages, offset, kind)
                exact = kind[1] in "iu" and kind[1:] != "u8"
                found[name] = values.astype(np.int64 if exact else np.float64)
        return found


def _values(messages: np.ndarray, offset: int, kind: str) -> np.ndarray:
    size = np.dtype(kind).itemsize
    return np.ascontiguousarray(messages[:, offset : offset + size]).view(kind)[:, 0]


def message_layout(raw: bytes, kind: str, types: Mapping[str, Any], *, ros1: bool) -> MessageLayout:
    """By the field definitions of `rosbags`. Raises FileFormatError for an early end and texts of wide letters."""
    walk = _Walk(raw, types, ros1)
    try:
        walk.structure(kind, "", 0)
    except struct.error as error:
        raise FileFormatError(f"a message of type {kind} ends before its last field.") from error
    return MessageLayout(raw, walk.places, np.asarray(walk.fixed, dtype=np.intp))


class _Walk:
    def __init__(self, raw: bytes, types: Mapping[str, Any], ros1: bool) -> None:
        self.raw = raw
        self.types = types
        self.ros1 = ros1
        self.order = ">" if not ros1 and len(raw) > 1 and raw[1] == 0 else "<"
        self.origin = self.position = 0 if ros1 else 4
        self.fixed: list[int] = [] if ros1 else [1]
        self.places: dict[str, tuple[int, str]] = {}

    def structure(self, kind: str, path: str, depth: int) -> None:
        if depth > DEEPEST:
            raise FileFormatError(f"messages are nested more than {DEEPEST} deep.")
        if kind in TIME:
            self._align(4)
            self._skip(path, self.order + "stamp", 8)
            return
        names: list[str] = []
        for name, description in self.types[kind][1]:
            own = f"{path}.{name}" if path else name
            if kind == JOINT_STATE and name == "name":
                names = self._names()
            elif kind == JOINT_STATE and name in ("position", "velocity", "effort"):
                self._of_joints(own, names)
            else:
                self._field(own, description, depth)

    def _field(self, path: str, description: Any, depth: int) -> None:
        node, content = description
        if node.name == "BASE":
            self._base(path, content[0])
        elif node.name == "NAME":
            self.structure(content, path, depth + 1)
        else:
            element, count = content
            if node.name == "SEQUENCE":
                count = self._length()
            plain = element[0].name == "BASE" and element[1][0] in NUMBERS
            if plain and count > LONGEST_VECTOR:  # a picture or a cloud of points
                size = np.dtype(NUMBERS[element[1][0]]).itemsize
                self._align(size)
                self._skip("", "", size * count)
                return
            for index in range(count):
                self._field(f"{path}[{index}]", element, depth + 1)

    def _base(self, path: str, kind: str) -> None:
        if kind == "string":
            length = self._length()
            self._skip("", "", length)
        elif kind in NUMBERS:
            size = np.dtype(NUMBERS[kind]).itemsize
            self._align(size)
            self._skip(path, self.order + NUMBERS[kind], size)
        else:
            raise FileFormatError(f"field {path!r} has the type {kind}, which is not read.")

    def _names(self) -> list[str]:
        names = []
        for _ in range(self._length()):
            length = self._length()
            text = self.raw[self.position : self.position + length]
            self.fixed.extend(range(self.position, self.position + length))
            self._skip("", "", length)
            names.append(text.rstrip(b"\0").decode("utf-8", "replace"))
        return names

    def _of_joints(self, path: str, names: list[str]) -> None:
        count = self._length()
        if count not in (0, len(names)):
            raise FileFormatError(f"a JointState has {len(names)} names but {count} values of {path!r}.")
        for name in names[:count]:
            self._base(f"{path}.{name}", "float64")

    def _length(self) -> int:
        self._align(4)
        (length,) = struct.unpack_from(self.order + "I", self.raw, self.position)
        self.fixed.extend(range(self.position, self.position + 4))
        self.position += 4
        if length > len(self.raw):
            raise FileFormatError(f"a message claims {length} elements in {len(self.raw)} bytes.")
        return length

    def _align(self, size: int) -> None:
        if not self.ros1:
            self.position += -(self.position - self.origin) % size

    def _skip(self, path: str, kind: str, size: int) -> None:
        if self.position + size > len(self.raw):
            raise struct.error("the message ends early")
        if path:
            self.places[path] = (self.position, kind)
        self.position += size
