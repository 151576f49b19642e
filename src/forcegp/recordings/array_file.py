"""Files that hold arrays by name, and the first of them: NumPy archives (.npz)."""

import fnmatch
import math
import re
import zipfile
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.lib import format as npy
from typing_extensions import override

from forcegp.errors import FileFormatError, InvalidInput
from forcegp.recordings.source import (
    LONGEST_VECTOR,
    Columns,
    Source,
    columns_of,
    element_names,
    reading,
    require_plausible_size,
)
from forcegp.summary import listed

SEPARATOR = "/"
MOST_NAMES = 12
"""Of arrays in a message."""


class ArrayFile(Source):
    """Arrays (rows,) and (rows, k) by name; the latter are the columns `name[0] ... name[k-1]`.

    With `within`, only what is under that name counts, and names begin after it: a file with one array or one group per
    episode is read as one table per episode. An array by itself is then `[0] ... [k-1]`.
    Subclasses list the arrays (`shapes`) and give them (`array`).
    """

    def __init__(self, path: Path, *, within: str | None = None) -> None:
        super().__init__(path)
        self.within = within

    @abstractmethod
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Every array of numbers by its full name; raises FileFormatError for a file that cannot be read."""

    @abstractmethod
    def array(self, name: str) -> np.ndarray:
        """The array of that full name."""

    def episodes(self, pattern: str) -> list[str]:
        """Names that a pattern such as `data/demo_*` matches, in the order of numbers. Raises InvalidInput for none."""
        depth = pattern.count(SEPARATOR) + 1
        names = dict.fromkeys(SEPARATOR.join(name.split(SEPARATOR)[:depth]) for name in self.shapes())
        found = [name for name in names if fnmatch.fnmatchcase(name, pattern)]
        if not found:
            raise InvalidInput(
                f"no array or group of {self.path} matches {pattern!r}; it has {listed(names, MOST_NAMES)}."
            )
        return sorted(found, key=_by_numbers)

    @cached_property
    def _places(self) -> dict[str, tuple[str, int | None]]:
        """Column -> (full name of its array, column in it)."""
        places: dict[str, tuple[str, int | None]] = {}
        for full, shape in self.shapes().items():
            name = self._name_within(full)
            if name is None or not shape or shape == (1,) or shape == (1, 1) or 0 in shape:
                continue
            if len(shape) == 1 or (len(shape) == 2 and shape[1] == 1 and name):
                places[name or "[0]"] = (full, None if len(shape) == 1 else 0)
            elif len(shape) == 2 and shape[1] <= LONGEST_VECTOR:
                places |= {element: (full, index) for index, element in enumerate(element_names(name, shape[1]))}
        if not places:
            inside = f" under {self.within!r}" if self.within else ""
            raise FileFormatError(
                f"{self.path} has no array of numbers with one or two dimensions and more than one row{inside}; "
                f"it has {listed(self.shapes(), MOST_NAMES)}."
            )
        return places

    def _name_within(self, full: str) -> str | None:
        if self.within is None:
            return full
        if full == self.within:
            return ""
        return full.removeprefix(self.within + SEPARATOR) if full.startswith(self.within + SEPARATOR) else None

    @override
    def columns(self) -> tuple[str, ...]:
        return tuple(self._places)

    @override
    def pieces(self, names: Sequence[str]) -> Iterator[Columns]:
        arrays = list(dict.fromkeys(self._places[name][0] for name in names))
        shapes = self.shapes()
        lengths = {shapes[array][0] for array in arrays}
        if len(lengths) > 1:
            counts = ", ".join(f"{array} {shapes[array][0]}" for array in arrays)
            raise FileFormatError(
                f"{self.path}: its arrays have different numbers of rows ({counts}); map those of one."
            )
        yield columns_of({name: self.array(name) for name in arrays}, {name: self._places[name] for name in names})


def _by_numbers(name: str) -> list[tuple[int, int, str]]:
    """So that demo_10 comes after demo_9."""
    parts = re.findall(r"\d+|\D", name)
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


WHAT = "a NumPy archive"
_ERRORS = (zipfile.BadZipFile, NotImplementedError)


class NumpyArchive(ArrayFile):
    """The arrays of an .npz file. What it claims to hold is compared with its size before anything is expanded."""

    @cached_property
    def _shapes(self) -> dict[str, tuple[int, ...]]:
        found = {}
        with reading(self.path, WHAT, *_ERRORS), zipfile.ZipFile(self.path) as archive:
            members = archive.infolist()
            declared = sum(member.file_size for member in members)
            require_plausible_size(self.path, "the archive", declared, self.path.stat().st_size)
            for member in members:
                require_plausible_size(self.path, repr(member.filename), member.file_size, member.compress_size)
                name = member.filename.removesuffix(".npy")
                if name == member.filename:
                    continue
                with archive.open(member) as stream:
                    read = npy.read_array_header_1_0 if npy.read_magic(stream) == (1, 0) else npy.read_array_header_2_0
                    shape, _, dtype = read(stream)
                if dtype.hasobject:
                    raise FileFormatError(
                        f"{self.path}: {name!r} holds Python objects, which are never read because reading them runs "
                        "code; save it as an array of numbers."
                    )
                if math.prod(shape) * dtype.itemsize > member.file_size:
                    raise FileFormatError(
                        f"{self.path}: {name!r} claims the shape {shape}, but the file does not hold that much."
                    )
                if dtype.kind in "fiu":
                    found[name] = shape
        return found

    @override
    def shapes(self) -> dict[str, tuple[int, ...]]:
        return self._shapes

    @override
    def array(self, name: str) -> np.ndarray:
        with reading(self.path, WHAT, *_ERRORS), np.load(self.path, allow_pickle=False) as archive:
            return archive[name]
