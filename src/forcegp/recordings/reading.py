"""One recording from a log: columns evaluated, and checked for values that make no sense."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

import forcegp.robots
from forcegp.errors import DatasetError, DataWarning, FileFormatError, MistakenUnit
from forcegp.recordings.signal_plan import JointSignal, SignalPlan
from forcegp.recordings.source import Columns, Source

TURN = 2.0 * np.pi


@dataclass(frozen=True)
class RawRecording:
    """What was read of one table.

    Fields
    ------
    label: what people call it, a file or an array in it.
    table: (rows, signals), the signals of the plan in SI.
    time: (rows,) [s] from its first row on.
    begin: the stamp of the log at the first row, in s.
    episodes: (n, 2) episode number of the log and row at which it begins; one row if the log numbers none.
    jumps: (n, 2) rows before which a turning joint moves by more than half a turn, and the column of the table.
    """

    label: str
    source: Source
    table: Float[np.ndarray, "rows signals"]
    time: Float[np.ndarray, " rows"]
    begin: float
    episodes: Int[np.ndarray, "n 2"]
    jumps: Int[np.ndarray, "n 2"]


def read_recording(source: Source, plan: SignalPlan, label: str, *, unwrap: bool, most_rows: int) -> RawRecording:
    """Read a table. Raises FileFormatError and DatasetError naming the file, the row, the time and the column."""
    columns = source.read(plan.columns) if plan.columns else {}
    rows = len(next(iter(columns.values()), ()))
    if rows == 0:
        raise FileFormatError(f"{label} has no rows; give a log with rows.")
    if rows > most_rows:
        raise FileFormatError(f"{label} has more than {most_rows} rows; allow more with `most_rows`.")
    time, begin = _seconds(columns, plan, source, rows)
    table = np.empty((rows, len(plan.signals)))
    for index, item in enumerate(plan.signals):
        table[:, index] = item.value(columns, rows)
    _require_finite(table, columns, plan, source, time)
    episodes = np.zeros((1, 2), np.int64) if plan.episode is None else _episodes(columns[plan.episode], source)
    jumps = _jumps(table, plan, episodes[:, 1], unwrap)
    return RawRecording(label, source, table, time, begin, episodes, jumps)


def _seconds(columns: Columns, plan: SignalPlan, source: Source, rows: int) -> tuple[np.ndarray, float]:
    """Seconds since the first row, and the stamp there.

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


def _jumps(table: np.ndarray, plan: SignalPlan, begins: np.ndarray, unwrap: bool) -> Int[np.ndarray, "n 2"]:
    """Where positions of turning joints step by more than half a turn, which with `unwrap` are continued instead."""
    columns = [i for i, item in enumerate(plan.signals) if item.signal == "q" and item.unit.si == "rad"]
    q = table[:, columns]
    steps = np.diff(q, axis=0, prepend=q[:1])
    steps[begins] = 0.0
    jumps = np.abs(steps) > np.pi
    if not unwrap:
        rows, found = np.nonzero(jumps)
        return np.stack([rows, np.array(columns, np.int64)[found]], axis=1)
    table[:, columns] = q + TURN * np.cumsum(-np.round(steps / TURN) * jumps, axis=0)
    return np.zeros((0, 2), np.int64)


def _require_finite(table: np.ndarray, columns: Columns, plan: SignalPlan, source: Source, times: np.ndarray) -> None:
    if np.isfinite(table).all():
        return
    row, index = (int(position) for position in np.argwhere(~np.isfinite(table))[0])
    item: JointSignal = plan.signals[index]
    wrong = [name for name in item.expression.weights if not np.isfinite(columns[name][row])]
    name = wrong[0] if wrong else next(iter(item.expression.weights), "")
    raise DatasetError(
        f"{source.path}: column {name!r} ({item.signal} of joint {item.joint!r}) is {_shown(columns[name][row])} at "
        f"{source.place(row)}, {times[row]:.6g} s from the start; {int((~np.isfinite(table)).sum())} such "
        "values in all. Repair or remove these rows, or map another column."
    )


def _shown(value: float) -> str:
    return "missing (empty or NaN)" if np.isnan(value) else f"{value}"


def _episodes(column: np.ndarray, source: Source) -> Int[np.ndarray, "n 2"]:
    """Number and first row of every episode."""
    numbers = np.asarray(column, dtype=np.float64)
    if not np.isfinite(numbers).all() or (numbers != np.round(numbers)).any():
        row = int(np.argmax(~np.isfinite(numbers) | (numbers != np.round(numbers))))
        raise DatasetError(f"{source.path}: the episode is {numbers[row]} at {source.place(row)}, not a whole number.")
    starts = np.concatenate([[0], np.flatnonzero(np.diff(numbers)) + 1])
    begun = numbers[starts].astype(np.int64)
    first = np.unique(begun, return_index=True)[1]
    if len(first) < len(begun):
        again = int(np.setdiff1d(np.arange(len(begun)), first)[0])
        raise DatasetError(
            f"{source.path}: episode {begun[again]} begins again at {source.place(int(starts[again]))}; rows of an "
            "episode must lie together. Sort the log by episode and time."
        )
    return np.stack([begun, starts], axis=1)


BEYOND = 0.1
"""Of its range: how far a position may be beyond the limits of the URDF. Stops give way, and zeros are set by hand."""

TURNS = 4.0 * np.pi
"""rad: positions of a joint beyond this whose unit is not stated as rad are taken for degrees."""

STRONGER = 3.0
"""Times the limit of the URDF that a force may be before it is warned of."""


def require_plausible_positions(
    recording: RawRecording, plan: SignalPlan, robot: forcegp.robots.Robot | None, stated: bool
) -> None:
    """Refuse positions far beyond the limits of the URDF; without a robot, those that look like degrees.

    `stated`: the unit of q was given, which is then believed where no URDF contradicts it.
    Raises DatasetError naming the joint, its range and what to do.
    """
    limits = {} if robot is None else {joint.name: (joint.lower, joint.upper) for joint in robot.joints}
    for index, item in enumerate(plan.signals):
        if item.signal != "q":
            continue
        low, high = recording.table[:, index].min(), recording.table[:, index].max()
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
            raise DatasetError(f"{seen} Are unit, sign, offset and URDF right? `beyond_limits` accepts it.")
        if degrees and not stated and not np.isfinite(upper - lower):
            hint = "Give `unit` q=deg if it is in degrees, `unit` q=rad if not."
            raise MistakenUnit(f"{where}, more than two turns. {hint}", "q", "deg")


def warn_of_implausible_forces(recording: RawRecording, plan: SignalPlan, robot: forcegp.robots.Robot | None) -> None:
    """Warn (DataWarning) of forces far beyond the limits of the URDF."""
    limits = {} if robot is None else {joint.name: joint.effort_limit for joint in robot.joints}
    for index, item in enumerate(plan.signals):
        limit = limits.get(item.joint, np.inf)
        most = float(np.abs(recording.table[:, index]).max())
        if item.signal == "u" and 0.0 < limit < np.inf and most > STRONGER * limit:
            warnings.warn(
                f"{recording.label}: u of joint {item.joint!r} reaches {most:.4g} {item.unit.si}; the URDF allows "
                f"{limit:.4g}. Is it in another unit (`unit` u=mNm), or on the motor's side of a gear (`scale`)?",
                DataWarning,
                stacklevel=2,
            )
