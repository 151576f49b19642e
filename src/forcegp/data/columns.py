"""Checked, private, read-only copies of numeric arrays: the only way numbers enter a Dataset."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from forcegp.errors import DatasetError
from forcegp.robots.real_numbers import real_array


def finite_columns(
    name: str, given: object, columns: Sequence[str] | None, rows: int | None = None, *, what: str = "rows"
) -> np.ndarray:
    """float64, C-contiguous, read-only copy of a table of finite numbers.

    `columns` None asks for a vector, names for one column each, and an empty sequence for any number of columns.
    Raises DatasetError naming the first row and column that are not finite, or the shape that was expected.
    """
    values = real_array(name, given, error=DatasetError).astype(np.float64)  # astype always copies
    expected = f"({what},)" if columns is None else f"({what}, {len(columns) or 'any'})"
    wrong_columns = columns is not None and values.ndim == 2 and columns and values.shape[1] != len(columns)
    if values.ndim != (1 if columns is None else 2) or wrong_columns:
        raise DatasetError(f"{name} has shape {values.shape}; expected {expected}.")
    if rows is not None and len(values) != rows:
        raise DatasetError(f"{name} has {len(values)} {what}; expected {rows}.")
    if values.shape[0] == 0:
        raise DatasetError(f"{name} has no {what}; at least one is needed.")
    bad = ~np.isfinite(values)
    if bad.any():
        position = np.argwhere(bad)[0]
        column = ""
        if columns is not None:
            column = f", column {position[1]}" + (f" ({columns[position[1]]})" if columns else "")
        raise DatasetError(
            f"{name} is {values[tuple(position)]} at row {position[0]}{column}; "
            f"{int(bad.sum())} values are not finite. Drop or repair these rows first."
        )
    return _read_only(values)


def integer_column(name: str, given: object, rows: int) -> np.ndarray:
    """int64, read-only copy of a vector of integers. Raises DatasetError for anything else."""
    values = real_array(name, given, "iu", DatasetError)
    if values.shape != (rows,):
        raise DatasetError(f"{name} has shape {values.shape}; expected ({rows},).")
    return _read_only(values.astype(np.int64))


def _read_only(values: np.ndarray) -> np.ndarray:
    values = np.ascontiguousarray(values)
    values.flags.writeable = False
    return values
