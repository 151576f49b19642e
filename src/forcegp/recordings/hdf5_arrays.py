"""HDF5 files of any layout: every dataset of numbers by its path."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import ClassVar

import h5py
import numpy as np
from typing_extensions import override

from forcegp.errors import FileFormatError
from forcegp.recordings.array_file import ArrayFile
from forcegp.recordings.size_limits import require_plausible_size
from forcegp.recordings.source import reading

WHAT = "an HDF5 file"


class HDF5Arrays(ArrayFile):
    """The datasets of an HDF5 file, which must lie in the file itself: links to other files are never followed.

    With `transposed`, arrays are stored column by column, as MATLAB does in its files of version 7.3.
    """

    transposed: ClassVar[bool] = False

    @cached_property
    def _arrays(self) -> dict[str, tuple[int, ...]]:
        with reading(self.path, WHAT), h5py.File(self.path, "r") as file:
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
    def blocks(self, name: str, rows: int) -> Iterator[np.ndarray]:
        with reading(self.path, WHAT), h5py.File(self.path, "r") as file:
            stored = file[name]
            assert isinstance(stored, h5py.Dataset)
            for start in range(0, self._arrays[name][0], rows):
                piece = stored[..., start : start + rows].T if self.transposed else stored[start : start + rows]
                yield piece
