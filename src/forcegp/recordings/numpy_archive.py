"""NumPy archives (.npz), member by member and piece by piece; Python objects are never loaded."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.lib import format as npy
from typing_extensions import override

from forcegp.errors import FileFormatError
from forcegp.recordings.array_file import ArrayFile, require_numbers
from forcegp.recordings.size_limits import require_plausible_size
from forcegp.recordings.source import reading

WHAT = "a NumPy archive"
_ERRORS = (zipfile.BadZipFile, NotImplementedError)


class NumpyArchive(ArrayFile):
    """The arrays of an .npz file. What it claims to hold is compared with its size before anything is expanded."""

    @cached_property
    def _arrays(self) -> dict[str, tuple[str, tuple[int, ...], bool, np.dtype]]:
        """Name -> (member, shape, column-major, type)."""
        found = {}
        with reading(self.path, WHAT, *_ERRORS), zipfile.ZipFile(self.path) as archive:
            members = archive.infolist()
            declared = sum(member.file_size for member in members)
            require_plausible_size(self.path, "the archive", declared, self.path.stat().st_size)
            for member in members:
                require_plausible_size(self.path, repr(member.filename), member.file_size, member.compress_size)
                if not member.filename.endswith(".npy"):
                    continue
                name = member.filename.removesuffix(".npy")
                with archive.open(member) as stream:
                    shape, column_major, dtype = _header(stream)
                if not require_numbers(self.path, name, dtype):
                    continue
                if math.prod(shape) * dtype.itemsize > member.file_size:
                    raise FileFormatError(
                        f"{self.path}: {name!r} claims the shape {shape}, but the file does not hold that much."
                    )
                if name in found:
                    raise FileFormatError(f"{self.path}: {name!r} is in the archive twice; write it again.")
                found[name] = (member.filename, shape, column_major, dtype)
        return found

    @override
    def shapes(self) -> dict[str, tuple[int, ...]]:
        return {name: shape for name, (_, shape, _, _) in self._arrays.items()}

    @override
    def blocks(self, name: str, rows: int) -> Iterator[np.ndarray]:
        member, shape, column_major, dtype = self._arrays[name]
        length = self.shapes()[name][0]
        with reading(self.path, WHAT, *_ERRORS), zipfile.ZipFile(self.path) as archive, archive.open(member) as stream:
            _header(stream)
            if column_major and len(shape) > 1:  # its first row ends where the array ends: there are no pieces
                table = np.frombuffer(stream.read(), dtype, count=math.prod(shape)).reshape(shape, order="F")
                yield from (table[start : start + rows] for start in range(0, length, rows))
                return
            row_bytes = dtype.itemsize * math.prod(shape[1:])
            for start in range(0, length, rows):
                count = min(rows, length - start)
                data = stream.read(count * row_bytes)
                if len(data) < count * row_bytes:
                    raise EOFError(f"{name!r} ends before its last row")
                yield np.frombuffer(data, dtype).reshape(count, *shape[1:])
            if stream.read(1):  # to the end, where the checksum is compared
                raise EOFError(f"{name!r} goes on after its last row")


def _header(stream) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = npy.read_magic(stream)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    return read(stream)
