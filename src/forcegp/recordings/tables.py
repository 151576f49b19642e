"""Tables: CSV, TSV and other text with one row per line, also compressed (.gz), and Parquet, read by pyarrow."""

import codecs
import csv
import gzip
import io
import re
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from datetime import date
from itertools import compress, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow_csv
from typing_extensions import override

from forcegp.errors import DataWarning, FileFormatError, InvalidInput
from forcegp.recordings.mapping import UNITS, named_unit
from forcegp.recordings.source import Columns, Source, arrow_numbers, reading, require_distinct, require_plausible_size

FIRST_BYTES = 2**16  # what is looked at to detect the header, the delimiter and whether there are comments
BLOCK = 2**22  # bytes that pyarrow parses at a time; no line may be longer
BLANKS = "blanks"
_COMMENT_LINE = re.compile(rb"^[ \t]*#[^\n]*\n?", re.MULTILINE)
_OUTER_BLANKS = re.compile(rb"^[ \t]+|[ \t]+$", re.MULTILINE)
_NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*(e[+-]?\d+)?|[.,]\d+(e[+-]?\d+)?|inf|nan)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(e[+-]?\d+)?", re.IGNORECASE)
_LONG_INTEGER = re.compile(r"\d{16,19}")
_TIME = re.compile(
    r"(?=.*\d[-/.:]\d)(\d{4}([-/.])\d\d?\2\d\d?|\d\d?\.\d\d?\.\d{4})?[T ]*"
    r"(\d\d?:\d\d(?::\d\d(?:[.,]\d+)?)?)?(?:Z|[+-]\d\d:?\d\d)?"
)
_UNITS = {unit.lower() for units in UNITS.values() for unit in units} | {"%", "sec", "°", "°/s", "-", "", "degrees"}
_REMEDY = "Repair or remove it, or leave such rows out by `bad_rows` skip."
LAST_LINES = 20  # of those that are looked at: they are rows, whatever stands above
_REFUSED = re.compile(r"In CSV column #(\d+): Row #(\d+): CSV conversion error to \w+: invalid value '(.*)'", re.DOTALL)
_RAGGED = re.compile(r"Row #(\d+): Expected (\d+) columns, got (\d+)")


class DelimitedText(Source):
    """A table as text. The first line that is not a comment (#) names the columns, unless `headerless` counts them.

    path: .csv, .tsv, .txt or .dat, also with .gz. headerless: number of columns of a file without a header, called c1,
    c2, ...; where every line holds one number, so many lines make a row.
    """

    def __init__(self, path: Path, *, headerless: int | None = None) -> None:
        super().__init__(path)
        if headerless is not None and headerless < 1:
            raise InvalidInput(f"headerless is {headerless}; give the number of columns, at least 1.")
        self._compressed = path.suffix.lower() == ".gz"
        if self._compressed:
            with reading(path, "text"), gzip.open(path) as stream:  # the size that it states is that of its last part
                while stream.read(BLOCK):
                    expanded = 4 * stream.tell()  # a number of two letters takes eight bytes
                    require_plausible_size(path, "what is compressed", expanded, path.stat().st_size)
        with reading(path, "text"), self._opened() as stream:
            self._notes = ["its letters are taken for cp1252"] if self.encoding == "cp1252" else []
            self._no_numbers: list[str] = []
            self._look(stream.peek(1), headerless)

    def _opened(self) -> Any:
        """The bytes of the file, expanded if it is called .gz. Raises FileFormatError for bytes that are no text."""
        path = self.path
        raw: Any = gzip.GzipFile(path, "rb") if self._compressed else io.FileIO(path)
        stream, first = io.BufferedReader(raw, 2**20), b""
        try:
            first = stream.peek(FIRST_BYTES)[:FIRST_BYTES]
            if not first.strip():
                raise FileFormatError(f"{path} is empty; give a log with rows.")
            self.encoding = _encoding(first)
            if self.encoding != "utf-8":
                with stream:
                    text = stream.read().decode(self.encoding, "replace")
                stream = io.BufferedReader(io.BytesIO(text.encode()), 2**20)
                first = stream.peek(FIRST_BYTES)[:FIRST_BYTES]
            if b"\0" in first:
                seen = f"{path} holds binary data, not text"
                raise FileFormatError(f"{seen}; if it is another format, give it that format's extension.")
        except BaseException:
            stream.close()
            raise
        return stream

    def _look(self, first: bytes, headerless: int | None) -> None:
        """Find delimiter, header, the number of lines before the first row, and whether there are comments."""
        lines, places, comments = list[str](), list[int](), list[str]()
        whole = first[: first.rfind(b"\n") + 1] if first.count(b"\n") > 1 else first
        for place, raw in enumerate(whole.splitlines()):
            text = raw.decode("utf-8", "replace")
            if text.lstrip().startswith("#"):
                comments += [] if len(lines) > 1 else [text.lstrip()[1:].strip()]
            elif text.strip():
                lines.append(text)
                places.append(place)
        if not lines:
            raise FileFormatError(f"{self.path} holds no rows, only comments or empty lines.")
        self._comments = bool(comments)

        def numbers(delimiter: str) -> tuple[int, int]:
            table = [line.split(None if delimiter == BLANKS else delimiter) for line in lines[-LAST_LINES:]]
            found = [[_is_number(field.strip(' "')) and bool(field) for field in row] for row in table]
            return sum(map(sum, found)), sum(map(all, found))

        # between which the most numbers stand, of equal ones that with more lines of nothing else
        self._delimiter = max((",", "\t", ";", "|", BLANKS), key=numbers)
        table = [self._fields(line) for line in lines]
        width = Counter(map(len, table[-LAST_LINES:])).most_common(1)[0][0]
        columns = zip(*(row for row in table[-LAST_LINES:] if len(row) == width), strict=True)
        numeric = [sum(map(_is_number, column)) * 2 >= len(column) for column in columns]
        like = [len(row) == width and any(row) and all(map(_is_number, compress(row, numeric))) for row in table]
        begin = like.index(True) if any(numeric) and any(like) else 1
        fields = table[begin] if begin < len(table) else []
        self._lines_per_row = 1
        if headerless is not None and (begin or len(fields) not in (1, headerless)):
            seen = f"{self.path} begins with {len(table[0])} fields, the first of them {table[0][0]!r}"
            asked = f"`headerless` is {headerless}: so many numbers on every line, or one"
            raise FileFormatError(f"{seen}; {asked}. Give another, or leave it out.")
        if not begin:
            self._lines_per_row = (headerless or 1) // len(fields) or 1
            named = self._fields(comments[-1]) if comments and headerless is None else []
            nameless = [f"c{index + 1}" for index in range(headerless or len(fields))]
            self._columns = named if len(named) == len(fields) else nameless
        else:
            if begin == len(table):
                raise FileFormatError(f"{self.path} has a header but no rows.")
            above = list(takewhile(lambda row: len(row) == len(fields), reversed(table[:begin])))[::-1]
            names = max(
                above or table[begin - 1 : begin],
                key=lambda row: len({x.strip("[]() ").lower() for x in row if not _is_number(x)} - _UNITS),
            )
            if len(names) + 1 == len(fields) and not fields[-1]:  # rows that end with a delimiter
                names = [*names, ""]
            self._columns = [name or f"column{index + 1}" for index, name in enumerate(names)]
            for row in (row for row in above if row is not names):
                left_out = ", ".join(dict.fromkeys(filter(None, self._without_units(row))))
                self._notes += [f"a line beside the names is left out: {left_out:.80}"] if left_out else []
        self._lines_before = places[begin]
        require_distinct(self.path, self._columns)
        whole = list(zip(self._columns, fields if self._lines_per_row == 1 else (), strict=False))
        self._long_integers = {name for name, text in whole if _LONG_INTEGER.fullmatch(text)}
        self._clocks = {name for name, text in whole if _TIME.fullmatch(text)}
        self._decimal = "," if any(_DECIMAL_COMMA.fullmatch(x) for row in table[begin:] for x in row) else "."

    def _without_units(self, row: Sequence[str]) -> Sequence[str]:
        """What is left of a line beside the names; if half of it are units, these are those of the columns."""
        texts = [text.strip("[]() ") for text in row]
        known = [any(named_unit(quantity, text, {text: text}) for quantity in UNITS) for text in texts]
        if 2 * sum(known) < sum(map(bool, texts)):
            return row
        self.units = {**self.units, **dict(compress(zip(self._columns, texts, strict=True), known))}
        return [text for text, is_unit in zip(texts, known, strict=True) if not is_unit]

    def _fields(self, line: str) -> list[str]:
        if self._delimiter == BLANKS:
            return line.split()
        with reading(self.path, "text with a delimiter"):  # a field of more than 131,072 letters, say
            row = next(csv.reader([line], delimiter=self._delimiter), [])
        return [field.strip() for field in row]

    @override
    def columns(self) -> tuple[str, ...]:
        return tuple(self._columns)

    @override
    def notes(self) -> tuple[str, ...]:
        return tuple(self._notes)

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
        kinds = dict.fromkeys(stored, pa.float64()) | dict.fromkeys(self._long_integers, pa.int64())
        table = self._parsed(stored, wanted, kinds | dict.fromkeys(self._clocks, pa.string()))
        columns = {name: arrow_numbers(table.column(name)) for name in {*wanted} - self._clocks}
        columns |= {name: seconds_of(table.column(name).to_pylist()) for name in self._clocks.intersection(wanted)}
        if not stacked:
            return columns
        values, width = columns["c1"], self._lines_per_row
        if len(values) % width:
            seen = f"{self.path} has {len(values)} numbers, which is no multiple of {width}"
            raise FileFormatError(f"{seen}; another `headerless` may be right, or the file is truncated.")
        return {name: values[self._columns.index(name) :: width] for name in names}

    def _parsed(self, stored: list[str], wanted: list[str], kinds: dict[str, Any], again: bool = False) -> Any:
        """The table; `again` after an error, with the row that it names, and without a line that was cut."""
        blanks = self._delimiter == BLANKS
        with reading(self.path, "text"), self._opened() as stream:
            for _ in range(self._lines_before):
                stream.readline()
            # pyarrow reads ahead on threads, in which a stream of Python's would crash where Python ends meanwhile
            cut, source = False, pa.input_stream(str(self.path), "gzip" if self._compressed else None)
            source.read(stream.tell())
            if self.encoding != "utf-8" or blanks or self._comments or again:
                text = _COMMENT_LINE.sub(b"", stream.read()) if self._comments else stream.read()
                cut = again and not text.endswith(b"\n")  # is it the line at which the log was cut?
                if cut:
                    text = text[: text.rfind(b"\n") + 1]
                if blanks:
                    text = re.sub(rb"[ \t]+", b"\t", _OUTER_BLANKS.sub(b"", text.replace(b"\r\n", b"\n")))
                source = pa.BufferReader(text)
            ragged: list[Any] = []
            words = {*arrow_csv.ConvertOptions().null_values, *self._no_numbers}
            skip = (lambda row: ragged.append(row) or "skip") if self.lenient else None
            reads = arrow_csv.ReadOptions(use_threads=False, block_size=BLOCK, column_names=stored)
            parses = arrow_csv.ParseOptions(delimiter="\t" if blanks else self._delimiter, invalid_row_handler=skip)
            converts = {"include_columns": wanted, "column_types": kinds, "decimal_point": self._decimal}
            converts["null_values"] = [*words]
            try:
                table = arrow_csv.read_csv(source, reads, parses, arrow_csv.ConvertOptions(**converts))
            except pa.ArrowInvalid as error:
                if not again:
                    return self._parsed(stored, wanted, kinds, again=True)
                found = _REFUSED.search(str(error))
                if self.lenient and found and len(self._no_numbers) < LAST_LINES:
                    self._no_numbers.append(found[3])
                    return self._parsed(stored, wanted, kinds, again=True)
                raise self._told_by_pyarrow(error) from error
            if len(ragged) > self.MOST_LOST * (len(table) + len(ragged)):
                seen = f"{self.path}: {len(ragged)} lines have other than {len(stored)} fields"
                raise FileFormatError(f"{seen}; repair it.")
            if ragged:
                self._notes += [f"lines left out because they have other than {len(stored)} fields: {len(ragged)}"]
            if cut:
                whole = f"the {len(table)} whole lines before are read"
                warnings.warn(f"{self.path} ends in the middle of a line: {whole}.", DataWarning, stacklevel=2)
            return table

    def _told_by_pyarrow(self, error: Exception) -> FileFormatError:
        text = str(error)

        def line(number: str) -> str:
            return self.place((int(number) - 1) // self._lines_per_row)  # pyarrow counts from 1

        if found := _REFUSED.search(text):
            name = "c1" if self._lines_per_row > 1 else self._columns[int(found[1])]
            text = f"column {name!r} holds {found[3]!r} at {line(found[2])}, which is no number. {_REMEDY}"
        elif found := _RAGGED.search(text):
            text = f"{line(found[1])} has {found[3]} fields instead of {found[2]}. {_REMEDY}"
        return FileFormatError(f"{self.path}: {text}")


def _encoding(first: bytes) -> str:
    """UTF-8 and UTF-16 where they show themselves, else the letters of Windows in Western Europe."""
    if first.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        first[: first.rfind(b"\n") + 1 or None].decode("utf-8")
    except UnicodeDecodeError:
        return "utf-8" if b"\0" in first else "cp1252"
    return "utf-8-sig" if first.startswith(codecs.BOM_UTF8) else "utf-8"


def _is_number(field: str) -> bool:
    """Whether a row may hold this: a number, a time, or nothing where a value was lost."""
    return not field or _NUMBER.fullmatch(field) is not None or _TIME.fullmatch(field) is not None


def seconds_of(texts: Sequence[str | None]) -> np.ndarray:
    """Dates and clock times in s; clocks without a date go on over midnight. NaN for what is neither."""
    seconds = np.full(len(texts), np.nan)
    for row, found in enumerate(_TIME.fullmatch((text or "").strip()) for text in texts):
        if found is not None:
            day = [int(part) for part in re.split(r"\D", found[1] or "1970-1-1")]
            with suppress(ValueError):  # a month 13
                days = date(*(day if day[0] > 31 else reversed(day))).toordinal() - date(1970, 1, 1).toordinal()
                hour, minute, second = f"{found[3] or '0:0'}:0".replace(",", ".").split(":")[:3]
                seconds[row] = 86400.0 * days + 3600 * int(hour) + 60 * int(minute) + float(second)
    return seconds + 86400.0 * np.cumsum((seconds < 86400.0) & (np.diff(seconds, prepend=seconds[:1]) < -43200.0))
