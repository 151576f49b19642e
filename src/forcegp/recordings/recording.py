"""One recording from a log: columns in SI, checked, continued, cut at gaps, and its rows as a Dataset has them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import make_interp_spline

import forcegp.robots
from forcegp.data.sampling import JITTER
from forcegp.errors import DatasetError, FileFormatError, MistakenUnit
from forcegp.recordings.joined_topics import Read, read_on_one_clock
from forcegp.recordings.moving_base import Jumps, Layout, read_poses
from forcegp.recordings.signal_plan import SignalPlan
from forcegp.recordings.source import Columns, Source


@dataclass(frozen=True)
class Recording:
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
    """

    label: str
    source: Source
    signals: Mapping[str, Float[np.ndarray, "rows entries"]]
    time: Float[np.ndarray, " rows"]
    begin: float
    episodes: Int[np.ndarray, "n 2"]
    ranges: Float[np.ndarray, "signals 2"]
    jumps: tuple[Jumps, ...]
    layout: Layout
    read: Read
    notes: tuple[str, ...]

    def rows(self, used: Int[np.ndarray, " rows"], step: float | None) -> dict[str, np.ndarray]:
        """Time and the signals q, v, u, a of these rows, `step` [s] apart, or for None at the times of the log."""
        time, signals = self.time[used], {name: values[used] for name, values in self.signals.items()}
        if step is not None:
            stamps, held = time, list(self.layout.held)
            count = int(np.floor((stamps[-1] - stamps[0]) / step * (1 + 1e-12))) + 1
            time = np.minimum(stamps[0] + step * np.arange(count), stamps[-1])
            before = np.searchsorted(stamps, time * (1 + 1e-12), side="right") - 1
            u = signals.get("u", np.zeros((len(stamps), 0)))[before]
            signals = {name: make_interp_spline(stamps, values, k=3)(time) for name, values in signals.items()}
            if held:
                signals["u"][:, held] = u[:, held]
        return {"time": time, **self.layout.signals(signals, time)}


def read_recording(source: Source, plan: SignalPlan, label: str, *, unwrap: bool) -> Recording:
    """Read a table. Raises FileFormatError and DatasetError naming the file, the row, the time and the column."""
    if not plan.columns:
        raise FileFormatError(f"{label} has no rows; give a log with rows.")
    read = read_on_one_clock(source, plan)
    columns = read.columns
    rows = len(columns[plan.columns[0]])
    time, begin = _seconds(plan, source, columns, rows)
    values = np.stack([item.value(columns, rows) for item in plan.signals], axis=1)
    _require_finite(values, columns, plan, source, time)
    episodes = np.zeros((1, 2), np.int64) if plan.episode is None else _episodes(columns[plan.episode], source)
    jumps = _continued(plan, values, episodes[:, 1], unwrap)
    ranges = np.stack([values.min(axis=0), values.max(axis=0)], axis=1)
    signals = {name: values[:, [item.signal == name for item in plan.signals]] for name in plan.logged}
    signals["q"], turned, told = read_poses(plan.layout.space, plan.orientation, source, signals["q"], episodes[:, 1])
    layout = replace(plan.layout, held=read.held or plan.layout.held)
    told = (*read.notes, *told)
    return Recording(label, source, signals, time, begin, episodes, ranges, (*jumps, *turned), layout, read, told)


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

TURNS = 4.0 * np.pi  # rad: positions of a joint beyond this whose unit is not stated as rad are taken for degrees


def require_plausible_positions(
    recording: Recording, plan: SignalPlan, robot: forcegp.robots.Robot | None, believed: Collection[str]
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


REPEATED = 0.05
"""Of the median step: a stamp that comes sooner after another is the same one again; nothing is sampled so unevenly."""

GAP = 10.0
"""Median steps. A cubic spline through samples g apart misses at most 5/384 (2 pi f g)^4 of the amplitude of a sine of
frequency f (Hall & Meyer 1976): across 10 steps at 1 kHz 0.013 % at 5 Hz and 3 % at 20 Hz. Longer pauses end an
episode."""

FEWEST_ROWS = 5  # Of an episode: two derivatives by central differences need so many
SLOWEST, FASTEST = 2.0, 2e5
"""Rows per second beyond which a log of a robot is taken for one whose time is in another unit."""


@dataclass(frozen=True)
class Stamps:
    """The stamps of one recording: `stretches` without gap, as episode number of the log and numbers of the rows.

    `step` is the median of the steps between rows that are used [s]; `worst` the largest relative deviation of a step
    within a stretch from it.
    """

    stretches: tuple[tuple[int, Int[np.ndarray, " rows"]], ...]
    step: float
    worst: float
    repeated: int
    gaps: tuple[float, ...]
    dropped_rows: int

    @property
    def even(self) -> bool:
        """Is every step within 1 % of the median?"""
        return self.worst <= JITTER


def read_stamps(recording: Recording, gap: float | None, start: float | None, end: float | None) -> Stamps:
    """Stretches of a recording between gaps of more than `gap` seconds (default `GAP` median steps).

    Rows in a pause of one topic of several are left out. Of rows with the same stamp the first is kept: what comes
    after it is a sample that was sent again, or one whose time is not known. `start` and `end` [s] are counted from the
    first row of each episode. Raises DatasetError for time that runs backwards, and for rates that no robot is logged
    at.
    """
    begins = recording.episodes[:, 1]
    typical = _typical_step(recording)
    _require_rate(recording, typical)
    kept = np.diff(recording.time, prepend=-np.inf) >= REPEATED * typical
    kept[begins] = True
    repeated = len(kept) - int(kept.sum())
    if start is not None or end is not None:
        kept &= _between(recording, start, end)
    paused = recording.read.paused(gap, GAP)
    used = np.flatnonzero(kept & ~paused)
    number = np.searchsorted(begins, used, side="right") - 1
    same = np.diff(number) == 0
    between = np.diff(recording.time[used])
    step = float(np.median(between[same])) if same.any() else typical
    limit = GAP * step if gap is None else gap
    inside = same & (between <= limit) & (np.diff(np.cumsum(paused)[used]) == 0)
    bounds = [0, *(np.flatnonzero(~inside) + 1).tolist(), len(used)]
    stretches, dropped = [], 0
    for first, last in pairwise(bounds):
        if last - first < FEWEST_ROWS:
            dropped += last - first
            continue
        stretches.append((int(recording.episodes[number[first], 0]), used[first:last]))
    if not stretches:
        raise DatasetError(
            f"{recording.label}: no {FEWEST_ROWS} rows lie together without a gap of more than {limit:.6g} s; "
            "a longer `gap` may be right."
        )
    gaps = tuple(between[same & ~inside].tolist())
    worst = float(np.abs(between[inside] / step - 1.0).max())
    return Stamps(tuple(stretches), step, worst, repeated, gaps, dropped)


def _typical_step(recording: Recording) -> float:
    """The median step within episodes. Raises DatasetError for time that runs backwards or stands still."""
    begins = recording.episodes[:, 1]
    steps = np.diff(recording.time)
    steps[begins[begins > 0] - 1] = np.nan
    backwards = np.flatnonzero(steps < 0)
    if backwards.size:
        row = int(backwards[0]) + 1
        raise DatasetError(
            f"{recording.label}: time runs backwards by {-steps[row - 1]:.6g} s at {recording.source.place(row)} "
            f"({recording.time[row]:.6g} s from the start), {backwards.size} times in all. Sort the log, map another "
            "column as the time, or name the column that numbers its episodes (`episode`)."
        )
    positive = steps[steps > 0]
    if len(recording.time) < FEWEST_ROWS:
        raise DatasetError(f"{recording.label} has {len(recording.time)} rows; an episode has at least {FEWEST_ROWS}.")
    if not positive.size:
        raise DatasetError(f"{recording.label}: all rows have the same time stamp; map another column as the time.")
    return float(np.median(positive))


def _between(recording: Recording, start: float | None, end: float | None) -> np.ndarray:
    """Rows from `start` to `end` seconds after the first of their episode. Raises DatasetError if there is none."""
    begins = recording.episodes[:, 1]
    counts = np.diff([*begins, len(recording.time)])
    since = recording.time - np.repeat(recording.time[begins], counts)
    inside = (since >= (-np.inf if start is None else start)) & (since <= (np.inf if end is None else end))
    if not inside.any():
        raise DatasetError(f"{recording.label}: no row lies between `start` and `end`; it has {since.max():.6g} s.")
    return inside


def _require_rate(recording: Recording, step: float) -> None:
    rate = 1.0 / step
    if SLOWEST <= rate <= FASTEST:
        return
    seen = f"{recording.label}: the median step is {step:.6g} s, {rate:.3g} rows per second, no rate of a robot's log."
    if rate > FASTEST:
        hint = "Is the time in s rather than in a smaller unit? Then add `unit` time=s."
        raise MistakenUnit(f"{seen} {hint}", "time", "s")
    factors = {"ms": 1e3, "us": 1e6, "ns": 1e9}
    fitting = [unit for unit, factor in factors.items() if 10.0 <= rate * factor <= 2e4]
    if fitting:
        hint = f"Is the time in {' or '.join(fitting)}? Then add `unit` time={fitting[0]}."
        raise MistakenUnit(f"{seen} {hint}", "time", fitting[0])
    raise DatasetError(f"{seen} Map another column as the time.")
