"""Parquet files."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import parquet, types
from typing_extensions import override

from forcegp.errors import FileFormatError
from forcegp.recordings.source import (
    LONGEST_VECTOR,
    Columns,
    Source,
    arrow_numbers,
    columns_of,
    element_names,
    reading,
    require_distinct,
)

WHAT = "a Parquet file"
LISTS = (types.is_list, types.is_large_list, types.is_fixed_size_list)


class ParquetFile(Source):
    """A Parquet file: its numeric columns, and the elements of its columns of lists of equal length.

    Lists are as long as in the first row; their elements are called `state[0]`.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._places: dict[str, tuple[str, int | None]] = {}  # column -> its name in the file, its place in a list
        self._widths: dict[str, int] = {}
        with reading(path, WHAT, pa.ArrowException), parquet.ParquetFile(path, pre_buffer=False) as file:
            require_distinct(path, file.schema_arrow.names)
            if not file.metadata.num_rows:
                raise FileFormatError(f"{path} has columns but no rows.")
            for field in file.schema_arrow:
                if _is_number(field.type):
                    self._places[field.name] = field.name, None
                elif any(is_list(field.type) for is_list in LISTS) and _is_number(field.type.value_type):
                    first = next(file.iter_batches(1, columns=[field.name])).column(0)[0]
                    if first.is_valid and 0 < len(first) <= LONGEST_VECTOR:
                        self._widths[field.name] = len(first)
        for name, width in self._widths.items():
            elements = element_names(name, width)
            require_distinct(path, [*self._places, *elements])
            self._places |= {element: (name, index) for index, element in enumerate(elements)}
        if not self._places:
            raise FileFormatError(f"{path} has no column of numbers.")

    @override
    def columns(self) -> tuple[str, ...]:
        return tuple(self._places)

    @override
    def table(self, names: Sequence[str]) -> Columns:
        places = {name: self._places[name] for name in names}
        stored = list(dict.fromkeys(own for own, _ in places.values()))
        with reading(self.path, WHAT, pa.ArrowException), parquet.ParquetFile(self.path, pre_buffer=False) as file:
            table = file.read(columns=stored)
            tables = {name: self._numbers(table.column(name).combine_chunks(), name) for name in stored}
        return columns_of(tables, places)

    def _numbers(self, column: pa.Array, name: str) -> np.ndarray:
        width = self._widths.get(name)
        if width is None:
            return arrow_numbers(column)
        lengths = pc.call_function("list_value_length", [column]).fill_null(0).to_numpy(zero_copy_only=False)
        wrong = np.flatnonzero(lengths != width)
        if wrong.size:
            raise FileFormatError(
                f"{self.path}: column {name!r} has {lengths[wrong[0]]} elements at {self.place(int(wrong[0]))}, "
                f"{width} before. Lists must be of one length."
            )
        return arrow_numbers(column.flatten()).reshape(len(column), width)


def _is_number(kind: pa.DataType) -> bool:
    return types.is_floating(kind) or types.is_integer(kind)
