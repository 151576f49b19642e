"""What a Dataset is made of: checked read-only columns, units, frozen metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

import forcegp.robots
from forcegp.errors import DatasetError
from forcegp.robots.arguments import real_array


class FrozenDict(dict[str, Any]):
    """`dict` whose mutating methods raise TypeError. Being a dict, `json.dumps` and `dict(...)` take it as it is."""

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise TypeError("this mapping belongs to a frozen value; change a copy: dict(mapping)")

    __setitem__ = __delitem__ = __ior__ = _refuse  # type: ignore[assignment]  # refuses whatever the arguments are
    clear = pop = popitem = setdefault = update = _refuse  # type: ignore[assignment]  # refuses whatever the arguments are

    def __reduce__(self) -> tuple[type[FrozenDict], tuple[dict[str, Any]]]:
        return FrozenDict, (dict(self),)  # the default would fill through __setitem__

    def copy(self) -> dict[str, Any]:
        """An ordinary dictionary with the same items."""
        return dict(self)


def frozen_json(metadata: Mapping[str, Any]) -> FrozenDict:
    """A mapping frozen at every level (lists become tuples). Raises DatasetError for what JSON does not have."""
    try:
        frozen = _freeze(json.loads(json.dumps(metadata, allow_nan=False)))
        if frozen != _freeze(metadata):  # json.dumps turns the key 1 into "1" without a word
            raise TypeError("a key is not text")
    except (TypeError, ValueError) as error:
        raise DatasetError(
            f"metadata cannot be written as JSON: {error}. "
            "Allowed: text, finite numbers, True, False, None, and lists or mappings of them."
        ) from error
    return frozen


def _freeze(value: Any) -> Any:
    if isinstance(value, Mapping):
        return FrozenDict({key: _freeze(item) for key, item in value.items()})
    if isinstance(value, list | tuple):
        return tuple(_freeze(item) for item in value)
    return value


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


ROTATION = {"q": "rad", "v": "rad/s", "u": "Nm", "a": "rad/s^2"}  # units of a revolute or continuous joint
TRANSLATION = {"q": "m", "v": "m/s", "u": "N", "a": "m/s^2"}  # units of a prismatic joint


def units_of(slides: Sequence[bool]) -> FrozenDict:
    """Units of q, v, u, a and time: one text where all joints agree, else one per joint."""
    each = {name: tuple((TRANSLATION if one else ROTATION)[name] for one in slides) for name in ROTATION}
    return FrozenDict(
        {name: texts[0] if len(set(texts)) == 1 else texts for name, texts in each.items()} | {"time": "s"}
    )


REVOLUTE_UNITS = units_of([False])  # of a robot whose joints all rotate


def sliding_joints(robot: forcegp.robots.Robot) -> tuple[str, ...]:
    """Names of the degrees of freedom that are lengths."""
    return tuple(name for name, joint in zip(robot.joint_names, robot.joints, strict=True) if joint.type == "prismatic")


def units_for(robot: forcegp.robots.Robot) -> FrozenDict:
    """The units that a Dataset of this robot has."""
    return units_of([name in sliding_joints(robot) for name in robot.joint_names])
