"""One recording from a log: columns evaluated, checked for values that make no sense, angles and turns continued."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

import forcegp.robots
from forcegp.errors import DatasetError, FileFormatError, MistakenUnit
from forcegp.recordings.moving_base import Jumps, read_poses
from forcegp.recordings.signal_plan import SignalPlan
from forcegp.recordings.source import Columns, Source


@dataclass(frozen=True)
class RawRecording:
    """What was read of one table.

    Fields
    ------
    label: what people call it, a file or an array in it.
    signals: those that were logged, (rows, entries) in SI, in the order of a Dataset.
    time: (rows,) [s] from its first row on.
    begin: the stamp of the log at the first row, in s.
    episodes: (n, 2) episode number of the log and row at which it begins; one row if the log numbers none.
    ranges: (signals, 2) least and largest value of each signal of the plan, in SI.
    jumps: rows before which a turning joint moves by more than half a turn, or a base by a quarter; what was
        seen, and what to do.
    notes: on the orientations of a base.
    """

    label: str
    source: Source
    signals: Mapping[str, Float[np.ndarray, "rows entries"]]
    time: Float[np.ndarray, " rows"]
    begin: float
    episodes: Int[np.ndarray, "n 2"]
    ranges: Float[np.ndarray, "signals 2"]
    jumps: tuple[Jumps, ...]
    notes: tuple[str, ...] = ()


def read_recording(source: Source, plan: SignalPlan, label: str, *, unwrap: bool, most_rows: int) -> RawRecording:
    """Read a table. Raises FileFormatError and DatasetError naming the file, the row, the time and the column."""
    if not plan.columns:
        raise FileFormatError(f"{label} has no rows; give a log with rows.")
    columns = source.read(plan.columns, most_rows)
    rows = len(columns[plan.columns[0]])
    time, begin = _seconds(plan, source, columns, rows)
    values = np.stack([item.value(columns, rows) for item in plan.signals], axis=1)
    _require_finite(values, columns, plan, source, time)
    episodes = np.zeros((1, 2), np.int64) if plan.episode is None else _episodes(columns[plan.episode], source)
    del columns
    jumps = _continued(plan, values, episodes[:, 1], unwrap)
    ranges = np.stack([values.min(axis=0), values.max(axis=0)], axis=1)
    signals = {name: values[:, [item.signal == name for item in plan.signals]] for name in plan.logged}
    signals["q"], turned, told = read_poses(plan.layout.space, plan.orientation, source, signals["q"], episodes[:, 1])
    return RawRecording(label, source, signals, time, begin, episodes, ranges, (*jumps, *turned), tuple(told))


def _seconds(plan: SignalPlan, source: Source, columns: Columns, rows: int) -> tuple[np.ndarray, float]:
    """Seconds since the first row, and its stamp in s.

    Whole numbers are subtracted as such: a float64 has no epochs in ns to 1 ns.
    """
    if plan.time is None:
        assert plan.step is not None
        return np.arange(rows) * plan.step, 0.0
    name = next(iter(plan.time.weights))
    whole = plan.time.is_column and columns[name].dtype == np.int64
    raw = columns[name] if whole else plan.time.value(columns, rows)
    if not whole and not np.isfinite(raw).all():
        row = int(np.argmin(np.isfinite(raw)))
        raise DatasetError(
            f"{source.path}: column {name!r}, the time, is {_shown(raw[row])} at {source.place(row)}. Repair or remove "
            "that row."
        )
    begin = float(plan.time_unit.in_si(raw[:1].astype(np.float64))[0])
    return plan.time_unit.in_si((raw - raw[0]).astype(np.float64)), begin


def _continued(plan: SignalPlan, values: np.ndarray, begins: np.ndarray, unwrap: bool) -> list[Jumps]:
    """Jumps of turning joints by more than half a turn; with `unwrap`, whole turns are added in `values` instead."""
    jumps = list[Jumps]()
    for column, item in enumerate(plan.signals):
        if item.signal != "q" or item.unit.si != "rad" or item.joint not in plan.joints:
            continue
        if unwrap:
            values[:, column] = np.concatenate([np.unwrap(each) for each in np.split(values[:, column], begins[1:])])
            continue
        steps = np.abs(np.diff(values[:, column], prepend=values[:1, column]))
        steps[begins] = 0.0
        seen = f"q of joint {item.joint!r} jumps by more than half a turn"
        remedy = "the angle wraps, or is in degrees. Add `unwrap`, or `unit` q=deg."
        jumps.append((np.flatnonzero(steps > np.pi), seen, remedy))
    return jumps


def _require_finite(
    values: np.ndarray, columns: Columns, plan: SignalPlan, source: Source, time: Float[np.ndarray, " rows"]
) -> None:
    if np.isfinite(values).all():
        return
    row, index = (int(position) for position in np.argwhere(~np.isfinite(values))[0])
    item = plan.signals[index]
    wrong = [name for name in item.expression.weights if not np.isfinite(columns[name][row])]
    name = wrong[0] if wrong else next(iter(item.expression.weights), "")
    raise DatasetError(
        f"{source.path}: column {name!r} ({item.signal} of joint {item.joint!r}) is {_shown(columns[name][row])} at "
        f"{source.place(row)}, {time[row]:.6g} s from the start; {int((~np.isfinite(values)).sum())} such values. "
        "Repair or remove these rows, or map another column."
    )


def _shown(value: float) -> str:
    return "missing (empty or NaN)" if np.isnan(value) else f"{value}"


def _episodes(column: np.ndarray, source: Source) -> Int[np.ndarray, "n 2"]:
    """Number and first row of every episode."""
    numbers = np.asarray(column, dtype=np.float64)
    odd = ~np.isfinite(numbers) | (numbers != np.round(numbers))
    if odd.any():
        row = int(np.argmax(odd))
        raise DatasetError(f"{source.path}: the episode is {numbers[row]} at {source.place(row)}, not a whole number.")
    starts = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1.0))
    own = numbers[starts].astype(np.int64)
    again = np.setdiff1d(np.arange(len(own)), np.unique(own, return_index=True)[1])
    if len(again):
        raise DatasetError(
            f"{source.path}: episode {own[again[0]]} begins again at {source.place(int(starts[again[0]]))}; rows of an "
            "episode must lie together. Sort the log by episode and time."
        )
    return np.stack([own, starts], axis=1)


BEYOND = 0.1
"""Of its range: how far a position may be beyond the limits of the URDF. Stops give way, and zeros are set by hand."""

TURNS = 4.0 * np.pi
"""rad: positions of a joint beyond this whose unit is not stated as rad are taken for degrees."""


def require_plausible_positions(
    recording: RawRecording, plan: SignalPlan, robot: forcegp.robots.Robot | None, believed: Collection[str]
) -> None:
    """Refuse positions far beyond the limits of the URDF; without a robot, those that look like degrees.

    `believed`: joints that may turn often, such as wheels; all where the unit of q was given.
    Raises DatasetError naming the joint, its range and what to do.
    """
    limits = {} if robot is None else {joint.name: (joint.lower, joint.upper) for joint in robot.joints}
    for index, item in enumerate(plan.signals):
        if item.signal != "q":
            continue
        low, high = recording.ranges[index]
        lower, upper = limits.get(item.joint, (-np.inf, np.inf))
        margin = BEYOND * (upper - lower) if np.isfinite(upper - lower) else 0.0
        beyond = low < lower - margin or high > upper + margin
        degrees = item.unit.name == "rad" and max(-low, high) > TURNS
        where = f"{recording.label}: q of joint {item.joint!r} runs from {low:.4g} to {high:.4g} {item.unit.si}"
        if beyond:
            seen = f"{where}, beyond its limits {lower:.4g} to {upper:.4g} in the URDF."
            if degrees:
                hint = "Is it in degrees? Then add `unit` q=deg. `beyond_limits` accepts it."
                raise MistakenUnit(f"{seen} {hint}", "q", "deg")
            raise DatasetError(f"{seen} Are unit, sign, zero and URDF right? `beyond_limits` accepts it.")
        if degrees and item.joint not in believed and not np.isfinite(upper - lower):
            hint = "Give `unit` q=deg if it is in degrees, `unit` q=rad if not."
            raise MistakenUnit(f"{where}, more than two turns. {hint}", "q", "deg")
