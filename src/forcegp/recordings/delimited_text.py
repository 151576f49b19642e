"""CSV, TSV and other text with one row per line, also compressed (.gz), read by pyarrow."""

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow_csv
from typing_extensions import override

from forcegp.errors import FileFormatError, InvalidInput
from forcegp.recordings.source import Columns, Source, arrow_numbers, gunzipped, reading, require_distinct

FIRST_BYTES = 2**20
"""What is looked at to detect the header, the delimiter and whether there are comments."""

COMMENT = b"#"
_COMMENT_LINE = re.compile(rb"^[ \t]*#[^\n]*\n?", re.MULTILINE)
_BLANKS = re.compile(rb"[ \t]+")
_OUTER_BLANKS = re.compile(rb"^[ \t]+|[ \t]+$", re.MULTILINE)


def _first_bytes(path: Path) -> bytes:
    """The beginning of a text file, expanded if it is called .gz. Raises FileFormatError for bytes that are no text."""
    if _is_compressed(path):
        first = gunzipped(path, FIRST_BYTES)
    else:
        with path.open("rb") as file:
            first = file.read(FIRST_BYTES)
    if not first.strip():
        raise FileFormatError(f"{path} is empty; give a log with rows.")
    _require_text(path, first)
    return first


def _is_compressed(path: Path) -> bool:
    return path.suffix.lower() == ".gz"


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


def _clean(raw: bytes, *, blanks: bool) -> bytes:
    """The lines without comments and, if `blanks`, with one tab between the words of a line."""
    if COMMENT in raw:
        raw = _COMMENT_LINE.sub(b"", raw)
    if blanks:
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
        with reading(path, "text"):
            self._look(_first_bytes(path), headerless, delimiter)
        self._long_integers = {
            name for name, text in zip(self._columns, self._first, strict=False) if _LONG_INTEGER.fullmatch(text)
        }

    def _look(self, first: bytes, headerless: int | None, delimiter: str | None) -> None:
        """Find header, delimiter, lines and bytes before the first row, and whether there are comments."""
        lines, comments, skipped, begin, header = [], [], 0, 0, 0
        for raw in first.splitlines(keepends=True):
            text = raw.decode("utf-8", "replace").lstrip("\ufeff").strip("\r\n")
            if text.lstrip().startswith("#"):
                comments.append(text.lstrip()[1:].strip())
            elif text.strip():
                lines.append(text)
            if not lines:
                skipped += 1
                begin += len(raw)
            elif not header:
                header = len(raw)
            if len(lines) == 2:
                break
        if not lines:
            raise FileFormatError(f"{self.path} holds no rows, only comments or empty lines.")
        self._comments = bool(comments)
        self._delimiter = delimiter or _detected_delimiter(lines, self.path)
        self._lines_before, self._begin = skipped, begin
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
            self._begin += header
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
    def read(self, names: Sequence[str]) -> Columns:
        self.require(names)
        try:
            return self._read(names, threads=True)
        except FileFormatError as error:
            if isinstance(error.__cause__, ValueError):  # pyarrow counts rows on one thread only
                self._read(names, threads=False)
            raise

    def _read(self, names: Sequence[str], *, threads: bool) -> Columns:
        stacked, blanks = self._lines_per_row > 1, self._delimiter == BLANKS
        stored = ["c1"] if stacked else self._columns
        kinds = {name: pa.int64() if name in self._long_integers else pa.float64() for name in stored}
        wanted = stored if stacked else list(names)
        with reading(self.path, "text"), self.path.open("rb") as file:
            source: Any = file
            if _is_compressed(self.path):
                source = io.BytesIO(gunzipped(self.path))
            source.seek(self._begin)
            if blanks or self._comments:
                source = io.BytesIO(_clean(source.read(), blanks=blanks))
            try:
                table = arrow_csv.read_csv(
                    source,
                    read_options=arrow_csv.ReadOptions(use_threads=threads, block_size=BLOCK, column_names=stored),
                    parse_options=arrow_csv.ParseOptions(delimiter="\t" if blanks else self._delimiter),
                    convert_options=arrow_csv.ConvertOptions(include_columns=wanted, column_types=kinds),
                )
            except pa.ArrowInvalid as error:
                raise self._told_by_pyarrow(error) from error
        columns = {name: arrow_numbers(table.column(name)) for name in wanted}
        return self._stacked(columns["c1"], names) if stacked else columns

    def _stacked(self, values: np.ndarray, names: Sequence[str]) -> Columns:
        """Rows from a file with one number per line."""
        width = self._lines_per_row
        if len(values) % width:
            raise FileFormatError(
                f"{self.path} has {len(values)} numbers, which is no multiple of {width}; another `headerless` may be "
                "right, or the file is truncated."
            )
        table = values.reshape(-1, width)
        return {name: np.ascontiguousarray(table[:, self._columns.index(name)]) for name in names}

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
