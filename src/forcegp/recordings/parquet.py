"""Parquet files, and folders of them as LeRobot writes."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import parquet, types
from typing_extensions import override

from forcegp.errors import FileFormatError
from forcegp.recordings.source import (
    LONGEST_VECTOR,
    ROWS_AT_A_TIME,
    Columns,
    Source,
    arrow_numbers,
    columns_of,
    element_names,
    reading,
    require_distinct,
)


class ParquetFile(Source):
    """A Parquet file: its numeric columns, and the elements of its columns of lists of equal length.

    Lists are of fixed size, or as long as in the first row. `names` gives elements of a list column names of their own:
    `observation.state.elbow` instead of `observation.state[0]`.
    """

    def __init__(self, path: Path, *, names: Mapping[str, Sequence[str]] | None = None) -> None:
        super().__init__(path)
        self._places: dict[str, tuple[str, int | None]] = {}  # column -> its name in the file, its place in a list
        self._widths: dict[str, int] = {}
        lists = {}
        with reading(path, "a Parquet file", pa.ArrowException), parquet.ParquetFile(path, pre_buffer=False) as file:
            self.rows = file.metadata.num_rows
            require_distinct(path, file.schema_arrow.names)
            if not self.rows:
                raise FileFormatError(f"{path} has columns but no rows.")
            for field in file.schema_arrow:
                if _is_number(field.type):
                    self._places[field.name] = field.name, None
                elif any(is_list(field.type) for is_list in LISTS) and _is_number(field.type.value_type):
                    first = next(file.iter_batches(1, columns=[field.name])).column(0)[0]
                    lists[field.name] = len(first) if first.is_valid else 0
        elements = []
        for name, width in lists.items():
            if 0 < width <= LONGEST_VECTOR:
                self._widths[name] = width
                own = (names or {}).get(name, ())
                named = [f"{name}.{part}" for part in own] if len(own) == width else element_names(name, width)
                elements += [(element, (name, index)) for index, element in enumerate(named)]
        require_distinct(path, [*self._places, *(element for element, _ in elements)])
        self._places |= dict(elements)
        if not self._places:
            raise FileFormatError(f"{path} has no column of numbers.")

    @override
    def columns(self) -> tuple[str, ...]:
        return tuple(self._places)

    @property
    @override
    def vectors(self) -> Mapping[str, tuple[str, ...]]:
        elements = [(column, stored) for column, (stored, index) in self._places.items() if index is not None]
        return {name: tuple(column for column, stored in elements if stored == name) for name in self._widths}

    @override
    def pieces(self, names: Sequence[str]) -> Iterator[Columns]:
        stored = list(dict.fromkeys(self._places[name][0] for name in names))
        row = 0
        with (
            reading(self.path, "a Parquet file", pa.ArrowException),
            parquet.ParquetFile(self.path, pre_buffer=False) as file,
        ):
            for batch in file.iter_batches(ROWS_AT_A_TIME, columns=stored):
                tables = {name: self._table(batch.column(name), name, row) for name in stored}
                row += len(batch)
                yield columns_of(tables, {name: self._places[name] for name in names})

    def _table(self, column: pa.Array, name: str, row: int) -> np.ndarray:
        if name not in self._widths:
            return arrow_numbers(column)
        width = self._widths[name]
        lengths = pc.call_function("list_value_length", [column]).fill_null(0).to_numpy(zero_copy_only=False)
        wrong = np.flatnonzero(lengths != width)
        if wrong.size:
            raise FileFormatError(
                f"{self.path}: column {name!r} has {lengths[wrong[0]]} elements at {self.place(row + int(wrong[0]))}, "
                f"{width} before. Lists must be of one length."
            )
        return arrow_numbers(column.flatten()).reshape(len(column), width)


def _is_number(kind: pa.DataType) -> bool:
    return types.is_floating(kind) or types.is_integer(kind)


LISTS = (types.is_list, types.is_large_list, types.is_fixed_size_list)
INFO = Path("meta") / "info.json"


class LeRobotFolder(Source):
    """A LeRobot dataset as one table: all rows of its data files in the order of their numbers.

    Columns are those of the Parquet files; where `info.json` names the elements of a list, they are
    `observation.state.<name>`. Videos are not looked at.
    Raises FileFormatError if the files do not hold what `info.json` states.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with reading(path / INFO, "JSON", AttributeError):
            info = json.loads((path / INFO).read_text(encoding="utf-8"))
            names = {name: given for name, feature in info["features"].items() if (given := _element_names(feature))}
            stated = info.get("total_frames")
        self.data_files = tuple(sorted((path / "data").glob("chunk-*/*.parquet")))
        if not self.data_files:
            raise FileFormatError(f"{path} has no data/chunk-*/*.parquet; the dataset was not copied whole.")
        outside = [file for file in self.data_files if not file.resolve().is_relative_to(path.resolve())]
        if outside and not path.is_symlink():
            raise FileFormatError(f"{outside[0]} is a link to a file outside of the dataset; copy the file there.")
        self._parts = [ParquetFile(file, names=names) for file in self.data_files]
        rows = sum(part.rows for part in self._parts)
        if rows != stated:
            raise FileFormatError(f"{path}: {INFO} has {stated} frames, the data files hold {rows}; copy it again.")

    @override
    def columns(self) -> tuple[str, ...]:
        return self._parts[0].columns()

    @property
    @override
    def vectors(self) -> Mapping[str, tuple[str, ...]]:
        return self._parts[0].vectors

    @override
    def files(self) -> tuple[Path, ...]:
        return (self.path / INFO, *self.data_files)

    @override
    def pieces(self, names: Sequence[str]) -> Iterator[Columns]:
        for part in self._parts:
            yield part.read(names)


def _element_names(feature: Any) -> list[str]:
    """What info.json calls the elements: a list of names, or a mapping to one (`{"motors": [...]}`)."""
    names = feature.get("names")
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))
    if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
        return []
    return names if len(set(names)) == len(names) else []
