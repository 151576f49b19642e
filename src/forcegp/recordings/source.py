"""`Source`: a log file as a table of named columns of numbers; how much a compressed one may hold."""

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from forcegp.errors import FileFormatError, ForceGPError, require_known

Columns = dict[str, np.ndarray]
"""Columns of equal length by name: float64 (rows,), or int64 where the file holds integers (stamps in nanoseconds)."""

LONGEST_VECTOR = 4096  # columns of a table in one array; wider ones are pictures and the like, not signals of joints
ELEMENT = re.compile(r"(?P<vector>.*)\[\d+\]$", re.DOTALL)
LARGEST_EXPANSION = 200
"""Logs of sensors shrink by a factor of 2 to 20, numbers written as text with all digits by 50 at most."""

HARMLESS = 100 * 2**20  # Bytes; what expands to no more than this is never refused


class Source(ABC):
    """One log: a table whose rows come one after the other in time.

    A subclass reads one format. `columns` names every column of numbers; an array of `k` numbers per row is `k` columns
    `name[0] ... name[k-1]`. `read` gives chosen ones, and only these have to fit into memory.
    Nothing in a file is executed and no link to another file is followed.

    Raises FileFormatError, with the path and what to do, from the constructor or from any method.
    """

    MOST_LOST: ClassVar[float] = 0.05
    """Of the rows: a driver loses single messages; what lacks more is another topic, sensor or log."""
    lenient = False
    """Whether rows that cannot be read, up to MOST_LOST of them, are left out."""
    units: Mapping[str, str] = MappingProxyType({})
    """Those that the file states by column, beside its names."""
    row_word: ClassVar[str] = "row"
    """What one row is called in messages."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @abstractmethod
    def columns(self) -> tuple[str, ...]:
        """The names of all columns, in the order of the file; not empty, no name twice."""

    @abstractmethod
    def table(self, names: Sequence[str]) -> Columns:
        """The named columns, all of which there are; a missing value is NaN."""

    def read(self, names: Sequence[str]) -> Columns:
        """The named columns, in this order. Raises FileFormatError for names that are no columns, and for no rows."""
        for name in names:
            require_known("column", name, str(self.path), self.columns(), FileFormatError)
        found = self.table(names)
        if not len(found[names[0]]):
            raise FileFormatError(f"{self.path} has no rows; give a log with rows.")
        if len({len(values) for values in found.values()}) > 1:
            raise FileFormatError(f"{self.path} has columns of different lengths; copy or write it again.")
        integers = [name for name in names if found[name].dtype.kind in "iu" and found[name].dtype != np.uint64]
        return {name: np.ascontiguousarray(found[name], np.int64 if name in integers else float) for name in names}

    @property
    def vectors(self) -> Mapping[str, tuple[str, ...]]:
        """Names that stand for several columns: `state` for `state[0], state[1], ...`."""
        found: dict[str, list[str]] = {}
        for name in self.columns():
            if element := ELEMENT.match(name):
                found.setdefault(element["vector"], []).append(name)
        return {name: tuple(elements) for name, elements in found.items()}

    def time_beside(self, names: Sequence[str]) -> str | None:
        """The column that is the time of these columns, if the format itself names it."""
        return None

    def files(self) -> tuple[Path, ...]:
        """The files that this log consists of."""
        return (self.path,)

    def notes(self) -> tuple[str, ...]:
        """Remarks on how the file was read; complete once it was."""
        return ()

    def place(self, row: int) -> str:
        """Where a row stands, for messages: `row 17`, counted from 0."""
        return f"{self.row_word} {row}"


def require_distinct(path: Path, names: Sequence[str]) -> None:
    """Refuse column names that repeat or are empty. Raises FileFormatError naming the column."""
    repeated = sorted(name for name, count in Counter(names).items() if count > 1)
    if repeated:
        places = [str(index + 1) for index, name in enumerate(names) if name == repeated[0]]
        seen = f"{path}: column name {repeated[0]!r} stands over columns {', '.join(places)}"
        raise FileFormatError(f"{seen}; rename all but one in the header.")


def element_names(name: str, width: int) -> list[str]:
    """`name[0] ... name[width-1]`."""
    return [f"{name}[{index}]" for index in range(width)]


def arrow_numbers(column: Any) -> np.ndarray:
    """A column of pyarrow; a missing value is NaN."""
    values = column.to_numpy(zero_copy_only=False)
    return values.astype(np.float64) if values.dtype == object or column.null_count else values


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Turn whatever a library meets in a damaged file into a FileFormatError; `what` is the format expected."""
    try:
        yield
    except (ForceGPError, MemoryError):
        raise
    except Exception as error:  # parsers raise what their authors did not think of: a TokenError for a header of NumPy
        reason = " ".join(str(error).split()) or type(error).__name__
        seen = f"{path} cannot be read as {what}: {reason.rstrip('.')}. It may be truncated or of another format"
        raise FileFormatError(f"{seen}; copy or write it again.") from error


def require_plausible_size(path: Path, what: str, declared: int, stored: int) -> None:
    """Refuse what claims to hold far more than it stores. Sizes in bytes. Raises FileFormatError."""
    if declared > HARMLESS and declared > LARGEST_EXPANSION * max(stored, 1):
        seen = f"{path}: {what} claims {declared / 2**20:.0f} MiB in {stored / 2**10:.0f} KiB of the file"
        why = f"more than {LARGEST_EXPANSION} times as much, and no log of sensors shrinks so far"
        raise FileFormatError(f"{seen}, {why}: it is truncated or no log. Copy or write it again.")
