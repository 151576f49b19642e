"""Files that hold arrays by name: NumPy archives (.npz), HDF5 of any layout, and MATLAB files of all versions."""

import fnmatch
import math
import re
import zipfile
from abc import abstractmethod
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import h5py
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
MOST_NAMES = 12  # of arrays in a message


class ArrayFile(Source):
    """Arrays (rows,) and (rows, k) by name; the latter are the columns `name[0] ... name[k-1]`.

    With `within`, only what is under that name counts, and names begin after it: a file with one array or one group per
    episode is read as one table per episode. An array by itself is then `[0] ... [k-1]`.
    Subclasses list the `shapes` of all arrays of numbers by full name, and give each `array`.
    """

    def __init__(self, path: Path, *, within: str | None = None) -> None:
        super().__init__(path)
        self.within = within

    @cached_property
    @abstractmethod
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of every array of numbers."""

    @abstractmethod
    def array(self, name: str) -> np.ndarray:
        """The array of that full name."""

    def episodes(self, pattern: str) -> list[str]:
        """Names that a pattern such as `data/demo_*` matches, in the order of numbers. Raises InvalidInput for none."""
        depth = pattern.count(SEPARATOR) + 1
        names = dict.fromkeys(SEPARATOR.join(name.split(SEPARATOR)[:depth]) for name in self.shapes)
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
        for full, shape in self.shapes.items():
            name = full
            if self.within is not None:
                if not f"{full}/".startswith(f"{self.within}/"):
                    continue
                name = full[len(self.within) + 1 :]
            if not shape or shape == (1,) or shape == (1, 1) or 0 in shape:
                continue
            if len(shape) == 1 or (len(shape) == 2 and shape[1] == 1 and name):
                places[name or "[0]"] = (full, None if len(shape) == 1 else 0)
            elif len(shape) == 2 and shape[1] <= LONGEST_VECTOR:
                places |= {element: (full, index) for index, element in enumerate(element_names(name, shape[1]))}
        if not places:
            inside = f" under {self.within!r}" if self.within else ""
            raise FileFormatError(
                f"{self.path} has no array of numbers with one or two dimensions and more than one row{inside}; "
                f"it has {listed(self.shapes, MOST_NAMES)}."
            )
        return places

    @override
    def columns(self) -> tuple[str, ...]:
        return tuple(self._places)

    @override
    def table(self, names: Sequence[str]) -> Columns:
        arrays = {self._places[name][0]: self.shapes[self._places[name][0]][0] for name in names}
        if len(set(arrays.values())) > 1:
            counts = ", ".join(f"{array} {rows}" for array, rows in arrays.items())
            raise FileFormatError(
                f"{self.path}: its arrays have different numbers of rows ({counts}); map those of one."
            )
        return columns_of({name: self.array(name) for name in arrays}, {name: self._places[name] for name in names})


def _by_numbers(name: str) -> list[tuple[int, int, str]]:
    """So that demo_10 comes after demo_9."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.findall(r"\d+|\D", name)]


NUMPY = "a NumPy archive"
_ERRORS = (zipfile.BadZipFile, NotImplementedError)


class NumpyArchive(ArrayFile):
    """The arrays of an .npz file. What it claims to hold is compared with its size before anything is expanded."""

    @cached_property
    @override
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """By the headers of its members."""
        found = {}
        with reading(self.path, NUMPY, *_ERRORS), zipfile.ZipFile(self.path) as archive:
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
    def array(self, name: str) -> np.ndarray:
        with reading(self.path, NUMPY, *_ERRORS), np.load(self.path, allow_pickle=False) as archive:
            return archive[name]


HDF5 = "an HDF5 file"


class HDF5Arrays(ArrayFile):
    """The datasets of an HDF5 file, which must lie in the file itself: links to other files are never followed.

    With `transposed`, arrays are stored column by column, as MATLAB does in its files of version 7.3.
    """

    transposed: ClassVar[bool] = False

    @cached_property
    @override
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of all groups."""
        found: dict[str, tuple[int, ...]] = {}
        with reading(self.path, HDF5), h5py.File(self.path, "r") as file:
            self._collect(file, "", found)
        return found

    def _collect(self, group: h5py.Group, prefix: str, found: dict[str, tuple[int, ...]]) -> None:
        for name in map(str, group):
            path, link = prefix + name, group.get(name, getlink=True)
            item = group[name] if isinstance(link, h5py.HardLink) else None  # a soft link is another name
            outside = isinstance(item, h5py.Dataset) and (item.external or item.is_virtual)
            if isinstance(link, h5py.ExternalLink) or outside:
                raise FileFormatError(
                    f"{self.path}: {path!r} is in another file, and links to other files are not followed; give that "
                    "file, or copy the data into one."
                )
            if isinstance(item, h5py.Group) and not name.startswith("#"):  # MATLAB keeps contents of cells there
                if prefix.count("/") > 32:
                    raise FileFormatError(f"{self.path}: its groups are nested more than 32 deep.")
                self._collect(item, f"{path}/", found)
            elif isinstance(item, h5py.Dataset) and item.dtype.kind in "fiu" and item.shape is not None:
                declared = item.size * item.dtype.itemsize
                require_plausible_size(self.path, repr(path), declared, item.id.get_storage_size())
                found[path] = tuple(item.shape[:: -1 if self.transposed else 1])

    @override
    def array(self, name: str) -> np.ndarray:
        with reading(self.path, HDF5), h5py.File(self.path, "r") as file:
            stored = file[name]
            assert isinstance(stored, h5py.Dataset)
            return stored[()].T if self.transposed else stored[()]


MATLAB = "a MATLAB file"
NOT_NUMBERS = {"cell", "object", "opaque", "function", "unknown"}


class MatlabHDF5(HDF5Arrays):
    """A MATLAB file of version 7.3: HDF5 whose arrays lie column by column."""

    transposed = True

    @cached_property
    @override
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Vectors stand upright."""
        arrays = super().shapes
        with reading(self.path, MATLAB), h5py.File(self.path, "r") as file:
            named = ((name, item) for name, item in file.items() if item is not None)  # None: a link to nothing
            cells = [name for name, item in named if item.attrs.get("MATLAB_class", b"") == b"cell"]
        if cells and not arrays:
            raise _cell(self.path, cells[0])
        return {name: (shape[1], 1) if _is_row(shape) else shape for name, shape in arrays.items()}

    @override
    def array(self, name: str) -> np.ndarray:
        return super().array(name).reshape(self.shapes[name])


class MatlabFile(ArrayFile):
    """A MATLAB file of version 5 to 7: its matrices, and those in structs, called `struct/field`.

    Vectors may lie either way. scipy reads whole variables, so what these hold must fit into memory.
    Raises FileFormatError for cells, which have no columns.
    """

    @cached_property
    def _arrays(self) -> dict[str, np.ndarray]:
        from scipy.io import loadmat, matlab

        with reading(self.path, MATLAB, matlab.MatReadError, NotImplementedError, MemoryError, IndexError):
            size = self.path.stat().st_size
            for name, shape, kind in matlab.whosmat(str(self.path)):
                require_plausible_size(self.path, repr(name), 8 * math.prod(shape), size)
                if kind in NOT_NUMBERS:
                    raise _cell(self.path, name)
            content = loadmat(str(self.path), struct_as_record=True)
        found: dict[str, np.ndarray] = {}
        for name, value in content.items():
            if not name.startswith("__"):
                self._collect(name, value, found)
        return found

    def _collect(self, name: str, value: np.ndarray, found: dict[str, np.ndarray]) -> None:
        if value.dtype.names and value.size == 1:
            for field in value.dtype.names:
                self._collect(f"{name}/{field}", value.ravel()[0][field], found)
        elif value.dtype.hasobject:
            raise _cell(self.path, name)
        elif value.dtype.kind in "fiu":
            found[name] = value.reshape(-1, 1) if _is_row(value.shape) else value

    @cached_property
    @override
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of what was read."""
        return {name: values.shape for name, values in self._arrays.items()}

    @override
    def array(self, name: str) -> np.ndarray:
        return self._arrays[name]


def matlab_file(path: Path, *, within: str | None = None) -> ArrayFile:
    """The reader for the version of a .mat file."""
    kind = MatlabHDF5 if path.is_file() and h5py.is_hdf5(path) else MatlabFile
    return kind(path, within=within)


def _is_row(shape: tuple[int, ...]) -> bool:
    return len(shape) == 2 and shape[0] == 1 and shape[1] > 1


def _cell(path: Path, name: str) -> FileFormatError:
    return FileFormatError(
        f"{path}: {name!r} is a cell, an object or an array of structs, which has no columns; "
        "save matrices of numbers (cell2mat)."
    )
