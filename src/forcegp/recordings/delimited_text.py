"""CSV, TSV and other text with one row per line, also compressed (.gz), read by pyarrow in pieces."""

import csv
import gzip
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow_csv
from typing_extensions import override

from forcegp.errors import FileFormatError, InvalidInput
from forcegp.recordings.source import (
    Columns,
    Source,
    arrow_numbers,
    reading,
    require_distinct,
    require_plausible_gzip,
)

FIRST_BYTES = 2**16
"""What is looked at to detect the header, the delimiter and whether there are comments."""

COMMENT = b"#"
_COMMENT_LINE = re.compile(rb"^[ \t]*#[^\n]*\n?", re.MULTILINE)
_BLANKS = re.compile(rb"[ \t]+")
_OUTER_BLANKS = re.compile(rb"^[ \t]+|[ \t]+$", re.MULTILINE)


def opened(path: Path) -> io.BufferedReader:
    """The bytes of a text file, expanded if it is called .gz. Raises FileFormatError for bytes that are no text."""
    compressed = path.suffix.lower() == ".gz"
    if compressed:
        require_plausible_gzip(path)
    raw: Any = gzip.GzipFile(path, "rb") if compressed else io.FileIO(path)
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


class CleanLines(io.RawIOBase):
    """A stream without comment lines and, if `blanks`, with one tab between the words of a line."""

    def __init__(self, stream: io.BufferedReader, *, blanks: bool) -> None:
        self.stream = stream
        self.blanks = blanks
        self._ready = b""

    @override
    def readable(self) -> bool:
        return True

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


BLOCK = 2**22
"""Bytes that pyarrow parses at a time; no line may be longer."""

BLANKS = "blanks"
DELIMITERS = {"comma": ",", "tab": "\t", "semicolon": ";", "blanks": BLANKS}
"""By the names that people may use for them."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|inf|nan)", re.IGNORECASE)
_LONG_INTEGER = re.compile(r"\d{16,19}")
_CONVERSION = re.compile(
    r"In CSV column #(\d+): (?:Row #(\d+): )?CSV conversion error to \w+: invalid value '(.*)'", re.DOTALL
)
_RAGGED = re.compile(r"(?:Row #(\d+): )?Expected (\d+) columns, got (\d+)")


class DelimitedText(Source):
    """A table as text. The first line that is not a comment (#) names the columns, unless `headerless` counts them.

    Parameters
    ----------
    path: .csv, .tsv, .txt or .dat, also with .gz.
    headerless: number of columns of a file without a header; they are called c1, c2, ... Where every line holds one
        number, so many lines make a row.
    delimiter: ",", ";", tab, another single letter, or "blanks" for any run of them. Default: detected from the
        first lines.
    """

    def __init__(self, path: Path, *, headerless: int | None = None, delimiter: str | None = None) -> None:
        super().__init__(path)
        if headerless is not None and headerless < 1:
            raise InvalidInput(f"headerless is {headerless}; give the number of columns, at least 1.")
        with reading(path, "text"), opened(path) as stream:
            self._look(stream, headerless, delimiter)
        self._long_integers = {
            name for name, text in zip(self._columns, self._first, strict=False) if _LONG_INTEGER.fullmatch(text)
        }

    def _look(self, stream, headerless: int | None, delimiter: str | None) -> None:
        """Find header, delimiter, number of lines before the first row, and whether there are comments."""
        lines, comments, skipped = [], [], 0
        first = stream.peek(1)
        for raw in stream.peek(len(first)).splitlines(keepends=True):
            text = raw.decode("utf-8", "replace").lstrip("\ufeff").strip("\r\n")
            if text.lstrip().startswith("#"):
                comments.append(text.lstrip()[1:].strip())
            elif text.strip():
                lines.append(text)
            if not lines:
                skipped += 1
            if len(lines) == 2:
                break
        if not lines:
            raise FileFormatError(f"{self.path} holds no rows, only comments or empty lines.")
        self._comments = bool(comments)
        self._delimiter = delimiter or _detected_delimiter(lines, self.path)
        self._lines_before = skipped
        fields = self._fields(lines[0])
        self._lines_per_row = 1
        if headerless is not None:
            self._without_header(fields, headerless)
        elif all(_NUMBER.fullmatch(field) for field in fields):
            named = self._fields(comments[-1]) if comments else []
            if len(named) != len(fields):
                raise FileFormatError(
                    f"{self.path} begins with numbers, not with names of columns; add `headerless` {len(fields)}, "
                    "or how many numbers make a row where every line holds one."
                )
            self._columns, self._first = named, fields
        else:
            self._columns = [name or f"column{index + 1}" for index, name in enumerate(fields)]
            self._first = self._fields(lines[1]) if len(lines) > 1 else []
            self._lines_before += 1
            if not self._first:
                raise FileFormatError(f"{self.path} has a header but no rows.")
        require_distinct(self.path, self._columns)

    def _without_header(self, fields: list[str], width: int) -> None:
        if not all(_NUMBER.fullmatch(field) for field in fields):
            raise FileFormatError(f"{self.path} begins with {fields[0]!r}, which is no number; leave `headerless` out.")
        if len(fields) not in (1, width):
            raise FileFormatError(
                f"{self.path} has {len(fields)} numbers on its first line; `headerless` is {width}. "
                "Either so many stand on every line, or one."
            )
        self._columns = [f"c{index + 1}" for index in range(width)]
        self._lines_per_row = width // len(fields)
        self._first = fields if len(fields) == width else []

    def _fields(self, line: str) -> list[str]:
        if self._delimiter == BLANKS:
            return line.split()
        with reading(self.path, "text with a delimiter", csv.Error):  # a field of more than 131,072 letters, say
            row = next(csv.reader([line], delimiter=self._delimiter), [])
        return [field.strip() for field in row]

    @override
    def columns(self) -> tuple[str, ...]:
        return tuple(self._columns)

    @override
    def place(self, row: int) -> str:
        if self._comments:
            return super().place(row)
        return f"row {row} (line {self._lines_before + row * self._lines_per_row + 1})"

    @override
    def pieces(self, names: Sequence[str]) -> Iterator[Columns]:
        try:
            yield from self._read(names, threads=True)
        except FileFormatError as error:
            if isinstance(error.__cause__, ValueError):  # pyarrow counts rows on one thread only
                for _ in self._read(names, threads=False):
                    pass
            raise

    def _read(self, names: Sequence[str], *, threads: bool) -> Iterator[Columns]:
        stacked = self._lines_per_row > 1
        stored = ["c1"] if stacked else self._columns
        kinds = {name: pa.int64() if name in self._long_integers else pa.float64() for name in stored}
        wanted = stored if stacked else list(names)
        stream = opened(self.path)
        with stream, reading(self.path, "text"):
            for _ in range(self._lines_before):
                stream.readline()
            blanks = self._delimiter == BLANKS
            source = CleanLines(stream, blanks=blanks) if blanks or self._comments else stream
            try:
                batches = arrow_csv.open_csv(
                    source,
                    read_options=arrow_csv.ReadOptions(use_threads=threads, block_size=BLOCK, column_names=stored),
                    parse_options=arrow_csv.ParseOptions(delimiter="\t" if blanks else self._delimiter),
                    convert_options=arrow_csv.ConvertOptions(include_columns=wanted, column_types=kinds),
                )
                columns = ({name: arrow_numbers(batch.column(name)) for name in wanted} for batch in batches)
                if stacked:
                    yield self._stacked(np.concatenate([batch["c1"] for batch in columns]), names)
                else:
                    yield from columns
            except pa.ArrowInvalid as error:
                raise self._told_by_pyarrow(error) from error

    def _stacked(self, values: np.ndarray, names: Sequence[str]) -> Columns:
        """Rows from a file with one number per line."""
        width = self._lines_per_row
        if len(values) % width:
            raise FileFormatError(
                f"{self.path} has {len(values)} numbers, which is no multiple of {width}; another `headerless` may be "
                "right, or the file is truncated."
            )
        return {name: values[self._columns.index(name) :: width] for name in names}

    def _told_by_pyarrow(self, error: Exception) -> FileFormatError:
        text = str(error)
        converted, ragged = _CONVERSION.search(text), _RAGGED.search(text)

        def line(number: str) -> str:
            return self.place((int(number) - 1) // self._lines_per_row)  # pyarrow counts from 1

        if converted:
            column, row, value = converted.groups()
            name = "c1" if self._lines_per_row > 1 else self._columns[int(column)]
            where = f" at {line(row)}" if row else ""
            return FileFormatError(
                f"{self.path}: column {name!r} holds {value!r}{where}, which is no number. {_remedy(value)}"
            )
        if ragged:
            row, expected, found = ragged.groups()
            where = f"{line(row)} has" if row else "one row has"
            return FileFormatError(
                f"{self.path}: {where} {found} fields instead of {expected}. Repair or remove it "
                "(the end of a log is often cut)."
            )
        return FileFormatError(f"{self.path} cannot be read as text: {text}")


def _remedy(value: str) -> str:
    if re.fullmatch(r"[+-]?\d+,\d+", value):
        return "Write decimal points instead of commas."
    if re.match(r"\d{4}-\d\d-\d\d|\d+:\d\d", value):
        return "Write the time as a number of seconds, or give `step`."
    return "Repair or remove that row."


def _detected_delimiter(lines: Sequence[str], path: Path) -> str:
    """The delimiter that stands equally often in the header and in the first row."""
    for letter in ("\t", ",", ";"):
        counts = {line.count(letter) for line in lines}
        if letter in lines[0] and (len(counts) == 1 or letter == ","):
            return letter
    if all(len(line.split()) == len(lines[0].split()) for line in lines) and len(lines[0].split()) > 1:
        return BLANKS
    if any(letter in lines[0] for letter in ";|") or len(lines[0].split()) > 1:
        raise FileFormatError(f"{path}: its delimiter cannot be detected; add `delimiter`.")
    return ","
