"""HDF5 files of any layout, MATLAB files of version 7.3 (which are HDF5), and those of versions 5 to 7 by scipy."""

import math
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import h5py
import numpy as np
from typing_extensions import override

from forcegp.errors import FileFormatError
from forcegp.recordings.array_file import ArrayFile
from forcegp.recordings.source import reading, require_plausible_size

HDF5 = "an HDF5 file"


class HDF5Arrays(ArrayFile):
    """The datasets of an HDF5 file, which must lie in the file itself: links to other files are never followed.

    With `transposed`, arrays are stored column by column, as MATLAB does in its files of version 7.3.
    """

    transposed: ClassVar[bool] = False

    @cached_property
    def _arrays(self) -> dict[str, tuple[int, ...]]:
        with reading(self.path, HDF5), h5py.File(self.path, "r") as file:
            found: dict[str, tuple[int, ...]] = {}
            self._collect(file, "", found)
        return found

    def _collect(self, group: h5py.Group, prefix: str, found: dict[str, tuple[int, ...]]) -> None:
        for name in map(str, group):
            path = prefix + name
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                raise FileFormatError(
                    f"{self.path}: {path!r} is a link to {link.filename}, and links to other files are not followed; "
                    "give that file, or copy the data into one."
                )
            if not isinstance(link, h5py.HardLink):
                continue  # a soft link is another name for what is in the file anyway
            item = group[name]
            if isinstance(item, h5py.Group):
                if prefix.count("/") > 32:
                    raise FileFormatError(f"{self.path}: its groups are nested more than 32 deep.")
                if not name.startswith("#"):  # MATLAB keeps the contents of cells and objects there
                    self._collect(item, f"{path}/", found)
            elif isinstance(item, h5py.Dataset) and self._counts(path, item):
                found[path] = tuple(reversed(item.shape)) if self.transposed else tuple(item.shape)

    def _counts(self, name: str, stored: h5py.Dataset) -> bool:
        if stored.external or stored.is_virtual:
            raise FileFormatError(
                f"{self.path}: {name!r} is stored in another file, which is not followed; copy the data into this one."
            )
        if stored.dtype.kind not in "fiu" or stored.shape is None:
            return False
        declared = stored.size * stored.dtype.itemsize
        require_plausible_size(self.path, repr(name), declared, stored.id.get_storage_size())
        return True

    @override
    def shapes(self) -> dict[str, tuple[int, ...]]:
        return self._arrays

    @override
    def array(self, name: str) -> np.ndarray:
        with reading(self.path, HDF5), h5py.File(self.path, "r") as file:
            stored = file[name]
            assert isinstance(stored, h5py.Dataset)
            return stored[()].T if self.transposed else stored[()]


WHAT = "a MATLAB file"
NOT_NUMBERS = {"cell", "object", "opaque", "function", "unknown"}


class MatlabHDF5(HDF5Arrays):
    """A MATLAB file of version 7.3: HDF5 whose arrays lie column by column."""

    transposed = True

    @cached_property
    def _arrays(self) -> dict[str, tuple[int, ...]]:
        arrays = super()._arrays
        with reading(self.path, WHAT), h5py.File(self.path, "r") as file:
            named = ((name, item) for name, item in file.items() if item is not None)  # None: a link to nothing
            cells = [name for name, item in named if item.attrs.get("MATLAB_class", b"") == b"cell"]
        if cells and not arrays:
            raise _cell(self.path, cells[0])
        return {name: (shape[1], 1) if _is_row(shape) else shape for name, shape in arrays.items()}

    @override
    def array(self, name: str) -> np.ndarray:
        return super().array(name).reshape(self._arrays[name])


class MatlabFile(ArrayFile):
    """A MATLAB file of version 5 to 7: its matrices, and those in structs, called `struct/field`.

    Vectors may lie either way. scipy reads whole variables, so what these hold must fit into memory.
    Raises FileFormatError for cells, which have no columns.
    """

    @cached_property
    def _arrays(self) -> dict[str, np.ndarray]:
        from scipy.io import loadmat, matlab

        errors = (matlab.MatReadError, NotImplementedError, MemoryError, IndexError)
        with reading(self.path, WHAT, *errors):
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

    @override
    def shapes(self) -> dict[str, tuple[int, ...]]:
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
