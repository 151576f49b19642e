"""How much a compressed file may hold: asked before anything is expanded."""

from __future__ import annotations

import gzip
import io
from pathlib import Path

from typing_extensions import override

from forcegp.errors import FileFormatError

LARGEST_EXPANSION = 200
"""Logs of sensors shrink by a factor of 2 to 20, numbers written as text with all digits by 50 at most."""

HARMLESS = 100 * 2**20
"""Bytes; what expands to no more than this is never refused."""


def require_plausible_size(path: Path, what: str, declared: int, stored: int) -> None:
    """Refuse what claims to hold far more than it stores. Sizes in bytes. Raises FileFormatError."""
    if declared > HARMLESS and declared > LARGEST_EXPANSION * max(stored, 1):
        raise FileFormatError(
            f"{path}: {what} claims {declared / 2**20:.0f} MiB in {stored / 2**10:.0f} KiB of the file, more than "
            f"{LARGEST_EXPANSION} times as much, and no log of sensors shrinks so far: it is truncated or no log. "
            "Copy or write it again."
        )


class Wrapper(io.RawIOBase):
    """A stream that is read from another, and closes it."""

    stream: io.BufferedIOBase

    @override
    def readable(self) -> bool:
        return True

    @override
    def close(self) -> None:
        self.stream.close()
        super().close()


class CountedStream(Wrapper):
    """What is read from a decompressor, refused as soon as it is implausibly more than the compressed file."""

    def __init__(self, path: Path, stream: io.BufferedIOBase) -> None:
        self.path = path
        self.stream = stream
        self.stored = path.stat().st_size
        self.expanded = 0

    @override
    def readinto(self, buffer) -> int:
        data = self.stream.read(len(buffer))
        buffer[: len(data)] = data
        self.expanded += len(data)
        require_plausible_size(self.path, "what is compressed", self.expanded, self.stored)
        return len(data)


def gzip_stream(path: Path) -> CountedStream:
    """The content of a .gz file. The size that it declares is checked first, what comes out is counted."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(2) != b"\x1f\x8b":
            raise FileFormatError(f"{path} is called .gz but is not compressed with gzip; rename or compress it.")
        file.seek(max(size - 4, 0))
        declared = int.from_bytes(file.read(4), "little")  # RFC 1952: ISIZE, modulo 2^32
    require_plausible_size(path, "what is compressed", declared, size)
    return CountedStream(path, gzip.open(path, "rb"))
