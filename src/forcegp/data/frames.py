"""A Dataset as a pandas DataFrame and back: one column per number, named `q.JOINT`."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np

from forcegp.errors import DatasetError, MissingExtra

TRUTH = "truth."


def frame_of(arrays: Mapping[str, np.ndarray], joint_names: tuple[str, ...]) -> Any:
    """Arrays (rows,) and (rows, columns) by name. Raises MissingExtra without pandas."""
    pandas = _pandas()
    columns = {}
    for name, values in arrays.items():
        if values.ndim == 1:
            columns[name] = values
            continue
        labels = joint_names if values.shape[1] == len(joint_names) else range(values.shape[1])
        columns |= {f"{name}.{label}": values[:, k] for k, label in enumerate(labels)}
    return pandas.DataFrame(columns)


def arrays_of(frame: Any) -> dict[str, Any]:
    """Arguments of a Dataset from the columns of `frame_of`, the joints in the order of q."""
    _pandas()
    joints = tuple(column[2:] for column in map(str, frame.columns) if column.startswith("q."))
    columns: dict[str, dict[str, np.ndarray]] = {}
    for column in map(str, frame.columns):
        ends = [joint for joint in joints if column.endswith(f".{joint}")]  # names may hold dots
        label = max(ends, key=len, default=column.rpartition(".")[2] if column.startswith(TRUTH) else "")
        columns.setdefault(column.removesuffix(f".{label}"), {})[label] = frame[column].to_numpy()
    missing = [name for name in ("q", "v", "u", "a", "time") if name not in columns]
    if missing:
        raise DatasetError(
            f"the frame lacks columns of {', '.join(missing)}; it needs time, and q.JOINT, v.JOINT, u.JOINT, "
            "a.JOINT of every joint, as to_pandas() writes them."
        )
    arrays: dict[str, Any] = {"joint_names": joints, "truth": {}}
    for name, parts in columns.items():
        labels = joints if set(parts) == set(joints) else tuple(parts)
        values = parts[""] if "" in parts else np.column_stack([parts[label] for label in labels])
        if name in ("q", "v", "u", "a", "noise_std") and labels != joints:
            raise DatasetError(f"the frame has {name} of {', '.join(parts)}, but q of {', '.join(joints)}.")
        (arrays["truth"] if name.startswith(TRUTH) else arrays)[name.removeprefix(TRUTH)] = values
    return arrays


def _pandas() -> Any:
    try:
        return import_module("pandas")
    except ImportError as error:
        raise MissingExtra("pandas is not installed; install it with: pip install 'forcegp[pandas]'") from error
