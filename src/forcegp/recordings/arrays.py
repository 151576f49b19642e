"""Files that hold arrays by name: NumPy archives (.npz), HDF5 of any layout, MATLAB of all versions, Parquet, JSON."""

import fnmatch
import json
import math
import re
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow.compute as pc
from numpy.lib import format as npy
from pyarrow import parquet, types
from typing_extensions import override

from forcegp.errors import DataWarning, FileFormatError, InvalidInput
from forcegp.recordings import source
from forcegp.recordings.tables import seconds_of
from forcegp.sandbox import MEMORY, SECONDS, read_apart
from forcegp.summary import listed

SEPARATOR = "/"
SHOWN = 12  # names of arrays in a message
NUMPY, HDF5, MATLAB, PARQUET = "a NumPy archive", "an HDF5 file", "a MATLAB file", "a Parquet file"
INTERNAL = "#"  # begins names under which MATLAB keeps the contents of cells
REFERENCE = np.dtype(object)
MOST_RAGGED = 10_000  # lists of different lengths in one, such as episodes
MOST_MISSING = 10**6  # numbers of a table of which its lines hold hardly any: each has names of its own

Arrays = Mapping[str, tuple[tuple[int, ...], Callable[[], np.ndarray]]]
"""By full name, shape and content of every array of numbers in a file."""


class ArrayFile(source.Source):
    """Arrays (rows,) and (rows, k) by name; the latter are the columns `name[0] ... name[k-1]`.

    With `within`, only what is under that name counts, and names begin after it: a file with one array or one group per
    episode is read as one table per episode. An array by itself is then `[0] ... [k-1]`.
    """

    def __init__(self, path: Path, arrays: Callable[[Path], Arrays], *, within: str | None = None) -> None:
        super().__init__(path)
        self._listed, self.within = arrays, within

    @cached_property
    def arrays(self) -> Arrays:
        """All of the file."""
        return self._listed(self.path)

    def episodes(self, pattern: str) -> list[str]:
        """Names that a pattern such as `data/demo_*` matches, in the order of numbers. Raises InvalidInput for none."""
        depth = pattern.count(SEPARATOR) + 1
        names = dict.fromkeys(SEPARATOR.join(name.split(SEPARATOR)[:depth]) for name in self.arrays)
        found = [name for name in names if fnmatch.fnmatchcase(name, pattern)]
        if not found:
            raise InvalidInput(f"no array or group of {self.path} matches {pattern!r}; it has {listed(names, SHOWN)}.")
        # demo_10 after demo_9
        return sorted(found, key=lambda name: [x.zfill(20) for x in re.findall(r"\d+|\D", name)])

    @cached_property
    def _places(self) -> dict[str, tuple[str, int | None]]:  # column -> (full name of its array, column in it)
        places: dict[str, tuple[str, int | None]] = {}
        for full, (shape, _) in self.arrays.items():
            name = full
            if self.within is not None:
                if not f"{full}/".startswith(f"{self.within}/"):
                    continue
                name = full[len(self.within) + 1 :]
            if not shape or shape in ((1,), (1, 1)) or 0 in shape:
                continue
            if len(shape) == 1 or (len(shape) == 2 and shape[1] == 1 and name):
                places[name or "[0]"] = (full, None if len(shape) == 1 else 0)
            elif len(shape) == 2 and shape[1] <= source.LONGEST_VECTOR:
                places |= {element: (full, index) for index, element in enumerate(source.element_names(name, shape[1]))}
        if not places:
            inside = f" under {self.within!r}" if self.within else ""
            seen = f"{self.path} has no array of numbers with one or two dimensions and more than one row{inside}"
            raise FileFormatError(f"{seen}; it has {listed(self.arrays, SHOWN)}.")
        return places

    @override
    def columns(self) -> tuple[str, ...]:
        return tuple(self._places)

    @override
    def table(self, names: Sequence[str]) -> source.Columns:
        chosen = {self._places[name][0]: self.arrays[self._places[name][0]] for name in names}
        if len({shape[0] for shape, _ in chosen.values()}) > 1:
            counts = ", ".join(f"{array} {shape[0]}" for array, (shape, _) in chosen.items())
            raise FileFormatError(f"{self.path}: arrays have different numbers of rows ({counts}); map those of one.")
        tables = {name: content() for name, (_, content) in chosen.items()}
        places = {name: self._places[name] for name in names}
        return {name: tables[own] if at is None else tables[own][:, at] for name, (own, at) in places.items()}


def numpy_arrays(path: Path) -> Arrays:
    """Of an .npz file. What it claims to hold is compared with its size before anything is expanded."""

    def content(name: str) -> np.ndarray:
        with source.reading(path, NUMPY), np.load(path, allow_pickle=False) as archive:
            return archive[name]

    found = {}
    with source.reading(path, NUMPY), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len({member.filename.removesuffix(".npy") for member in members}) < len(members):
            raise FileFormatError(f"{path} holds two arrays of one name; save it again, each under its own.")
        source.require_plausible_size(path, "the archive", sum(x.file_size for x in members), path.stat().st_size)
        for member in members:
            source.require_plausible_size(path, repr(member.filename), member.file_size, member.compress_size)
            name = member.filename.removesuffix(".npy")
            if name == member.filename:
                continue
            with archive.open(member) as stream:
                read = npy.read_array_header_1_0 if npy.read_magic(stream) == (1, 0) else npy.read_array_header_2_0
                shape, _, dtype = read(stream)
            if dtype.hasobject:
                seen = f"{path}: {name!r} holds Python objects, which are never read because reading them runs code"
                raise FileFormatError(f"{seen}; save it as an array of numbers.")
            if math.prod(shape) * dtype.itemsize > member.file_size:
                raise FileFormatError(f"{path}: {name!r} claims the shape {shape}, but the file holds less than that.")
            if dtype.kind in "fiu":
                if len(shape) < 3:
                    source.require_plausible_size(path, repr(name), 8 * math.prod(shape), member.compress_size)
                found[name] = shape, lambda name=name: content(name)
    return found


def hdf5_arrays(path: Path) -> Arrays:
    """Of all groups of an HDF5 file, in which they must lie: links to other files are never followed."""

    def content(name: str) -> np.ndarray:
        with source.reading(path, HDF5), h5py.File(path, "r") as file:
            stored = file[name]
            assert isinstance(stored, h5py.Dataset)
            return stored[()]

    with source.reading(path, HDF5), h5py.File(path, "r") as file:
        found = list(_stored(path, file, "", set()))
        flat = [(8 * math.prod(shape), size) for _, shape, size in found if len(shape) < 3]  # no pictures
        source.require_plausible_size(path, "the file", *(sum(sizes) for sizes in zip((0, 0), *flat, strict=True)))
        return {name: (shape, lambda name=name: content(name)) for name, shape, _ in found}


def _stored(path: Path, group: h5py.Group, prefix: str, seen: set[Any]) -> Iterator[tuple[str, tuple[int, ...], int]]:
    """Name, shape and stored bytes of arrays; a group of several names counts by the first, else it may be endless."""
    seen.add(group)
    for name in map(str, group):
        full, link = prefix + name, group.get(name, getlink=True)
        item = group[name] if isinstance(link, h5py.HardLink) else None  # a soft link is another name
        outside = isinstance(item, h5py.Dataset) and (item.external or item.is_virtual)
        if isinstance(link, h5py.ExternalLink) or outside:
            outer = f"{path}: {full!r} is in another file, and links to other files are not followed"
            raise FileFormatError(f"{outer}; give that file, or copy the data into one.")
        if isinstance(item, h5py.Group) and item not in seen:
            if prefix.count("/") > 32:
                raise FileFormatError(f"{path}: its groups are nested more than 32 deep.")
            yield from _stored(path, item, f"{full}/", seen)
        elif isinstance(item, h5py.Dataset) and item.dtype.kind in "fiu" and item.shape is not None:
            stored = item.id.get_storage_size()
            source.require_plausible_size(path, repr(full), item.size * item.dtype.itemsize, stored)
            yield full, tuple(item.shape), stored


def matlab_arrays(path: Path) -> Arrays:
    """Of a .mat file: its matrices, and those in structs, called `struct/field`, and in cells. Vectors lie either way.

    Of version 5 to 7, scipy reads whole variables, so these must fit into memory. One of 7.3 is HDF5, by columns.
    """
    if path.is_file() and h5py.is_hdf5(path):
        arrays = hdf5_arrays(path)
        with source.reading(path, MATLAB), h5py.File(path, "r") as file:
            if file.visititems(lambda _, item: True if getattr(item, "dtype", None) == REFERENCE else None):
                left = iter(range(path.stat().st_size // 8))  # a reference takes so many bytes
                return _lists({x: _referred(file, file[x], left) for x in map(str, file) if x[0] != INTERNAL})
        turned = {name: shape[::-1] for name, (shape, _) in arrays.items() if name[0] != INTERNAL}
        upright = {name: shape[::-1] if len(shape) == 2 and shape[0] == 1 else shape for name, shape in turned.items()}
        return {
            name: (shape, lambda name=name, shape=shape: arrays[name][1]().T.reshape(shape))
            for name, shape in upright.items()
        }
    with source.reading(path, MATLAB), tempfile.TemporaryDirectory() as folder:
        kept, size = Path(folder, "kept.npz"), path.stat().st_size
        asked = {"path": str(path), "kept": str(kept), "most": max(source.HARMLESS, source.LARGEST_EXPANSION * size)}
        asked |= {"seconds": SECONDS + (size >> 22), "memory": MEMORY + 50 * size}
        answer = read_apart("matlab", str(path), asked, FileFormatError, "save it again, as arrays of numbers")
        if "refused" in answer:
            raise ValueError(answer["refused"])
        with np.load(kept, allow_pickle=False) as arrays:
            restored = {name: arrays[name] for name in arrays.files}
        return _lists(json.loads(answer["content"], object_hook=lambda own: restored[own["#"]] if "#" in own else own))


def _referred(file: h5py.File, item: Any, left: Iterator[int]) -> Any:
    """The content of a part of a MATLAB file as mappings, lists (cells, fields of arrays of structs) and arrays."""
    if next(left, None) is None:
        raise ValueError("its cells hold each other")
    if isinstance(item, h5py.Group):
        return {name: _referred(file, item[name], left) for name in item}
    if item.dtype == REFERENCE:
        return [_referred(file, file[reference], left) for reference in item[()].T.ravel()]
    return np.squeeze(item[()].T)


def json_arrays(path: Path) -> Arrays:
    """Of JSON, or of lines that are JSON each: arrays, and rows of a list of objects. The last line may be cut."""
    with source.reading(path, "JSON"):
        text = path.read_text(encoding="utf-8-sig")
        try:
            return _lists(json.loads(text))
        except json.JSONDecodeError:
            *lines, last = filter(str.strip, text.splitlines())
            rows = [json.loads(line) for line in lines]
            try:
                return _lists([*rows, json.loads(last)])
            except json.JSONDecodeError:
                if not rows:
                    raise
        whole = f"the {len(rows)} whole lines before are read"
        warnings.warn(f"{path} ends in the middle of a line: {whole}.", DataWarning, stacklevel=2)
        return _lists(rows)


def _lists(content: Any) -> Arrays:
    found = {name.lstrip(SEPARATOR): values for name, values in _numbers(content, "")}
    return {name: (values.shape, lambda values=values: values) for name, values in found.items()}


def _numbers(value: Any, name: str) -> Iterator[tuple[str, np.ndarray]]:
    """Entries of a list are rows where they are alike and more than each has numbers; else they are called 1, 2, ..."""
    if isinstance(value, Mapping):
        texts = (own for key, own in value.items() if (key == "name" or key.endswith("names")) and type(own) is list)
        names = next(texts, ())
        for key, inside in value.items():
            named = type(inside) is list and inside is not names and len(inside) == len(names) > 0
            yield from _numbers(dict(zip(names, inside, strict=True)) if named else inside, f"{name}/{key}")
        return
    array = seconds_of([value])[0] if isinstance(value, str) else value
    with suppress(TypeError, ValueError, OverflowError):  # an integer of 400 digits
        array = np.array(array)
        array = np.array(value, dtype=np.float64) if array.dtype == object else array
        if array.dtype.kind in "fiub" and not (isinstance(value, str) and np.isnan(array)):
            yield name, array
            return
    if isinstance(value, list | np.ndarray):
        if len({len(own) for own in value if type(own) is list}) > 1 and len(value) > MOST_RAGGED:
            raise ValueError(f"a list of {len(value)} lists of different lengths")
        parts = [dict(_numbers(inside, "")) for inside in value]
        shapes = {key: own.shape for part in parts for key, own in part.items()}
        if all(own.shape == shapes[key] and own.size < len(parts) for part in parts for key, own in part.items()):
            if len(shapes) * len(parts) > max(MOST_MISSING, source.LARGEST_EXPANSION * sum(map(len, parts))):
                raise ValueError(f"{len(parts)} entries of a list have {len(shapes)} names, each of them few")
            for key, shape in shapes.items():
                lost = np.full(shape, np.nan)
                yield name + key, np.array([part.get(key, lost) for part in parts])
        else:
            for number, part in enumerate(parts, 1):
                yield from ((f"{name}/{number}{key}", own) for key, own in part.items())


def parquet_arrays(path: Path) -> Arrays:
    """Of a Parquet file: numeric columns, and columns of lists of equal length, that of the first row."""

    def content(name: str, width: int | None) -> np.ndarray:
        with source.reading(path, PARQUET), parquet.ParquetFile(path, pre_buffer=False) as file:
            column = file.read(columns=[name], use_threads=False).column(name).combine_chunks()
            if width is None:
                return source.arrow_numbers(column)
            lengths = pc.call_function("list_value_length", [column]).fill_null(0).to_numpy(zero_copy_only=False)
            for row in np.flatnonzero(lengths != width)[:1]:
                seen = f"{path}: column {name!r} has {lengths[row]} elements at row {row}, {width} before"
                raise FileFormatError(f"{seen}; lists must be of one length.")
            return source.arrow_numbers(column.flatten()).reshape(len(column), width)

    widths: dict[str, int | None] = {}
    with source.reading(path, PARQUET), parquet.ParquetFile(path, pre_buffer=False) as file:
        rows, stored = file.metadata.num_rows, file.metadata
        if not rows:
            raise FileFormatError(f"{path} has columns but no rows.")
        groups = (stored.row_group(index) for index in range(stored.num_row_groups))
        values = sum(group.column(index).num_values for group in groups for index in range(stored.num_columns))
        source.require_plausible_size(path, "a column", 8 * values, path.stat().st_size)  # equal numbers take no space
        for field in file.schema_arrow:
            if types.is_floating(field.type) or types.is_integer(field.type):
                widths[field.name] = None
            elif types.is_list(field.type) or types.is_large_list(field.type) or types.is_fixed_size_list(field.type):
                first, kind = next(file.iter_batches(1, columns=[field.name])).column(0)[0], field.type.value_type
                if first.is_valid and len(first) and (types.is_floating(kind) or types.is_integer(kind)):
                    widths[field.name] = len(first)
        elements = [
            name for own, width in widths.items() for name in (source.element_names(own, width) if width else [own])
        ]
        source.require_distinct(path, [*(name for name in file.schema_arrow.names if name not in widths), *elements])
    return {
        name: ((rows,) if width is None else (rows, width), lambda name=name, width=width: content(name, width))
        for name, width in widths.items()
    }


ARRAYS: dict[str, Callable[[Path], Arrays]] = {
    ".npz": numpy_arrays,
    ".mat": matlab_arrays,
    **dict.fromkeys((".h5", ".hdf5"), hdf5_arrays),
    **dict.fromkeys((".parquet", ".pq"), parquet_arrays),
    **dict.fromkeys((".json", ".jsonl", ".ndjson"), json_arrays),
}
