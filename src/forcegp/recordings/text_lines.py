"""Text logs as bytes: opened, looked at, and without comments and runs of blanks where a reader wants none."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

from typing_extensions import override

from forcegp.errors import FileFormatError
from forcegp.recordings.size_limits import Wrapper, gzip_stream

FIRST_BYTES = 2**16
"""What is looked at to detect the header, the delimiter and whether there are comments."""

COMMENT = b"#"
_COMMENT_LINE = re.compile(rb"^[ \t]*#[^\n]*\n?", re.MULTILINE)
_BLANKS = re.compile(rb"[ \t]+")
_OUTER_BLANKS = re.compile(rb"^[ \t]+|[ \t]+$", re.MULTILINE)


def opened(path: Path) -> io.BufferedReader:
    """The bytes of a text file, expanded if it is called .gz. Raises FileFormatError for bytes that are no text."""
    raw: Any = gzip_stream(path) if path.suffix.lower() == ".gz" else io.FileIO(path)
    stream = io.BufferedReader(raw, 2**20)
    try:
        first = stream.peek(FIRST_BYTES)[:FIRST_BYTES]
        if not first.strip():
            raise FileFormatError(f"{path} is empty; give a log with rows.")
        _require_text(path, first)
    except BaseException:
        stream.close()
        raise
    return stream


def _require_text(path: Path, first: bytes) -> None:
    if b"\0" in first:
        raise FileFormatError(
            f"{path} holds binary data, not text; if it is another format, give it that format's extension."
        )
    try:
        first[: first.rfind(b"\n") + 1 or None].decode("utf-8")
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{path} is not UTF-8 text (byte {error.start} is {first[error.start]:#04x}); save it as UTF-8."
        ) from error


class CleanLines(Wrapper):
    """A stream without comment lines and, if `blanks`, with one tab between the words of a line."""

    def __init__(self, stream: io.BufferedReader, *, blanks: bool) -> None:
        self.stream = stream
        self.blanks = blanks
        self._ready = b""

    @override
    def readinto(self, buffer) -> int:
        while not self._ready:
            raw = self.stream.read(2**20)
            if not raw:
                return 0
            if not raw.endswith(b"\n"):
                raw += self.stream.readline(2**24)
            self._ready = self._clean(raw)
        count = min(len(buffer), len(self._ready))
        buffer[:count] = self._ready[:count]
        self._ready = self._ready[count:]
        return count

    def _clean(self, raw: bytes) -> bytes:
        if COMMENT in raw:
            raw = _COMMENT_LINE.sub(b"", raw)
        if self.blanks:
            raw = _BLANKS.sub(b"\t", _OUTER_BLANKS.sub(b"", raw.replace(b"\r\n", b"\n")))
        return raw
