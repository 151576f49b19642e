"""Tables: CSV, TSV and other text with one row per line, also compressed (.gz), and Parquet, read by pyarrow."""

import csv
import gzip
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

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
    require_plausible_size,
)

FIRST_BYTES = 2**16  # what is looked at to detect the header, the delimiter and whether there are comments
BLOCK = 2**22  # bytes that pyarrow parses at a time; no line may be longer
BLANKS = "blanks"
DELIMITERS = {"comma": ",", "tab": "\t", "semicolon": ";", "blanks": BLANKS}
"""By the names that people may use for them."""

_COMMENT_LINE = re.compile(rb"^[ \t]*#[^\n]*\n?", re.MULTILINE)
_OUTER_BLANKS = re.compile(rb"^[ \t]+|[ \t]+$", re.MULTILINE)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|inf|nan)", re.IGNORECASE)
_LONG_INTEGER = re.compile(r"\d{16,19}")
_CONVERSION = re.compile(
    r"In CSV column #(\d+): (?:Row #(\d+): )?CSV conversion error to \w+: invalid value '(.*)'", re.DOTALL
)
_RAGGED = re.compile(r"(?:Row #(\d+): )?Expected (\d+) columns, got (\d+)")


class DelimitedText(Source):
    """A table as text. The first line that is not a comment (#) names the columns, unless `headerless` counts them.

    path: .csv, .tsv, .txt or .dat, also with .gz. headerless: number of columns of a file without a header, called c1,
    c2, ...; where every line holds one number, so many lines make a row. delimiter: ",", ";", tab, another single
    letter, or "blanks" for any run of them; default: detected from the first lines.
    """

    def __init__(self, path: Path, *, headerless: int | None = None, delimiter: str | None = None) -> None:
        super().__init__(path)
        if headerless is not None and headerless < 1:
            raise InvalidInput(f"headerless is {headerless}; give the number of columns, at least 1.")
        with reading(path, "text"), self._opened() as stream:
            self._look(stream.peek(1), headerless, delimiter)

    def _opened(self) -> io.BufferedReader:
        """The bytes of the file, expanded if it is called .gz. Raises FileFormatError for bytes that are no text."""
        path, compressed = self.path, self.path.suffix.lower() == ".gz"
        if compressed:
            size = path.stat().st_size
            with path.open("rb") as file:
                if file.read(2) != b"\x1f\x8b":
                    raise FileFormatError(
                        f"{path} is called .gz but is not compressed with gzip; rename or compress it."
                    )
                file.seek(max(size - 4, 0))
                declared = int.from_bytes(file.read(4), "little")  # RFC 1952: ISIZE, modulo 2^32
            require_plausible_size(path, "what is compressed", declared, size)
        raw: Any = gzip.GzipFile(path, "rb") if compressed else io.FileIO(path)
        stream = io.BufferedReader(raw, 2**20)
        first = b""
        try:
            first = stream.peek(FIRST_BYTES)[:FIRST_BYTES]
            if not first.strip():
                raise FileFormatError(f"{path} is empty; give a log with rows.")
            if b"\0" in first:
                raise FileFormatError(
                    f"{path} holds binary data, not text; if it is another format, give it that format's extension."
                )
            first[: first.rfind(b"\n") + 1 or None].decode("utf-8")
        except BaseException as error:
            stream.close()
            if isinstance(error, UnicodeDecodeError):
                where = f"byte {error.start} is {first[error.start]:#04x}"
                raise FileFormatError(f"{path} is not UTF-8 text ({where}); save it as UTF-8.") from error
            raise
        return stream

    def _look(self, first: bytes, headerless: int | None, delimiter: str | None) -> None:
        """Find header, delimiter, number of lines before the first row, and whether there are comments."""
        lines, comments, self._lines_before = [], [], 0
        for raw in first.splitlines(keepends=True):
            text = raw.decode("utf-8", "replace").lstrip("\ufeff").strip("\r\n")
            if text.lstrip().startswith("#"):
                comments.append(text.lstrip()[1:].strip())
            elif text.strip():
                lines.append(text)
            self._lines_before += not lines
            if len(lines) == 2:
                break
        if not lines:
            raise FileFormatError(f"{self.path} holds no rows, only comments or empty lines.")
        self._comments = bool(comments)
        self._delimiter = delimiter or _detected_delimiter(lines, self.path)
        fields = row = self._fields(lines[0])
        numbers = all(_NUMBER.fullmatch(field) for field in fields)
        self._lines_per_row = 1
        if headerless is not None:
            if not numbers:
                raise FileFormatError(
                    f"{self.path} begins with {fields[0]!r}, which is no number; leave `headerless` out."
                )
            if len(fields) not in (1, headerless):
                raise FileFormatError(
                    f"{self.path} has {len(fields)} numbers on its first line; `headerless` is {headerless}. "
                    "Either so many stand on every line, or one."
                )
            self._columns = [f"c{index + 1}" for index in range(headerless)]
            self._lines_per_row = headerless // len(fields)
        elif numbers:
            self._columns = self._fields(comments[-1]) if comments else []
            if len(self._columns) != len(fields):
                raise FileFormatError(
                    f"{self.path} begins with numbers, not with names of columns; add `headerless` {len(fields)}, "
                    "or how many numbers make a row where every line holds one."
                )
        else:
            if len(lines) < 2:
                raise FileFormatError(f"{self.path} has a header but no rows.")
            self._columns = [name or f"column{index + 1}" for index, name in enumerate(fields)]
            row = self._fields(lines[1])
            self._lines_before += 1
        require_distinct(self.path, self._columns)
        whole = zip(self._columns, row if self._lines_per_row == 1 else (), strict=False)
        self._long_integers = {name for name, text in whole if _LONG_INTEGER.fullmatch(text)}

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
    def table(self, names: Sequence[str]) -> Columns:
        stacked = self._lines_per_row > 1
        stored = ["c1"] if stacked else self._columns
        wanted = stored if stacked else list(names)
        kinds = {name: pa.int64() if name in self._long_integers else pa.float64() for name in stored}
        table = self._parsed(stored, wanted, kinds)
        columns = {name: arrow_numbers(table.column(name)) for name in wanted}
        if not stacked:
            return columns
        values, width = columns["c1"], self._lines_per_row
        if len(values) % width:
            raise FileFormatError(
                f"{self.path} has {len(values)} numbers, which is no multiple of {width}; another `headerless` may be "
                "right, or the file is truncated."
            )
        return {name: values[self._columns.index(name) :: width] for name in names}

    def _parsed(self, stored: list[str], wanted: list[str], kinds: dict[str, Any], threads: bool = True) -> Any:
        blanks = self._delimiter == BLANKS
        with reading(self.path, "text"), self._opened() as stream:
            for _ in range(self._lines_before):
                stream.readline()
            source: Any = stream
            if blanks or self._comments:
                text = _COMMENT_LINE.sub(b"", stream.read())
                if blanks:
                    text = re.sub(rb"[ \t]+", b"\t", _OUTER_BLANKS.sub(b"", text.replace(b"\r\n", b"\n")))
                source = io.BytesIO(text)
            try:
                return arrow_csv.read_csv(
                    source,
                    read_options=arrow_csv.ReadOptions(use_threads=threads, block_size=BLOCK, column_names=stored),
                    parse_options=arrow_csv.ParseOptions(delimiter="\t" if blanks else self._delimiter),
                    convert_options=arrow_csv.ConvertOptions(include_columns=wanted, column_types=kinds),
                )
            except pa.ArrowInvalid as error:
                if threads:  # pyarrow counts rows on one thread only
                    return self._parsed(stored, wanted, kinds, threads=False)
                raise self._told_by_pyarrow(error) from error

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
    words = {len(line.split()) for line in lines}
    if len(words) == 1 and words != {1}:
        return BLANKS
    if any(letter in lines[0] for letter in ";|") or len(lines[0].split()) > 1:
        raise FileFormatError(f"{path}: its delimiter cannot be detected; add `delimiter`.")
    return ","
