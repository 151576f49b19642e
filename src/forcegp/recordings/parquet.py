"""Parquet files, read by pyarrow row group by row group."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import parquet, types
from typing_extensions import override

from forcegp.errors import FileFormatError
from forcegp.recordings.source import (
    LONGEST_VECTOR,
    Columns,
    Source,
    as_column,
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

        self._scalars: dict[str, str] = {}
        self._elements: dict[str, tuple[str, int]] = {}
        self._widths: dict[str, int] = {}
        with reading(path, "a Parquet file", pa.ArrowException), parquet.ParquetFile(path, pre_buffer=False) as file:
            self.rows = file.metadata.num_rows
            require_distinct(path, file.schema_arrow.names)
            if not self.rows:
                raise FileFormatError(f"{path} has columns but no rows.")
            lists = []
            for field in file.schema_arrow:
                if _is_number(field.type):
                    self._scalars[field.name] = field.name
                elif _is_list(field.type) and _is_number(field.type.value_type):
                    lists.append(field.name)
            for name in lists:
                first = next(file.iter_batches(1, columns=[name])).column(0)[0]
                width = len(first) if first.is_valid else 0
                if 0 < width <= LONGEST_VECTOR:
                    self._widths[name] = width
                    own = (names or {}).get(name)
                    elements = [f"{name}.{part}" for part in own] if own and len(own) == width else []
                    for index, element in enumerate(elements or element_names(name, width)):
                        self._elements[element] = (name, index)
        require_distinct(path, list(self.columns()))
        if not self.columns():
            raise FileFormatError(f"{path} has no column of numbers.")

    @override
    def columns(self) -> tuple[str, ...]:
        return (*self._scalars, *self._elements)

    @property
    @override
    def vectors(self) -> Mapping[str, tuple[str, ...]]:
        found: dict[str, list[str]] = {}
        for element, (name, _) in self._elements.items():
            found.setdefault(name, []).append(element)
        return {name: tuple(elements) for name, elements in found.items()}

    @override
    def chunks(self, names: Sequence[str], rows: int) -> Iterator[Columns]:
        self.require(names)
        stored = list(dict.fromkeys(self._elements[name][0] if name in self._elements else name for name in names))
        row = 0
        with (
            reading(self.path, "a Parquet file", pa.ArrowException),
            parquet.ParquetFile(self.path, pre_buffer=False) as file,
        ):
            for batch in file.iter_batches(rows, columns=stored):
                if not len(batch):
                    continue
                tables = {name: self._table(batch.column(name), name, row) for name in stored if name in self._widths}
                columns: Columns = {}
                for name in names:
                    if name in self._elements:
                        vector, index = self._elements[name]
                        columns[name] = as_column(tables[vector][:, index])
                    else:
                        columns[name] = as_column(_plain(batch.column(name)))
                row += len(batch)
                yield columns

    def _table(self, column: pyarrow.Array, name: str, row: int) -> np.ndarray:
        width = self._widths[name]
        lengths = pc.call_function("list_value_length", [column]).fill_null(0).to_numpy(zero_copy_only=False)
        wrong = np.flatnonzero(lengths != width)
        if wrong.size:
            raise FileFormatError(
                f"{self.path}: column {name!r} has {lengths[wrong[0]]} elements at {self.place(row + int(wrong[0]))}, "
                f"{width} before. Lists must be of one length."
            )
        return _plain(column.flatten()).reshape(len(column), width)


def _plain(column: pyarrow.Array) -> np.ndarray:
    values = column.to_numpy(zero_copy_only=False)
    return values.astype(np.float64) if values.dtype == object or column.null_count else values


def _is_number(kind: pyarrow.DataType) -> bool:
    return types.is_floating(kind) or types.is_integer(kind)


def _is_list(kind: pyarrow.DataType) -> bool:
    return types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)
