"""One recording from a log: columns in SI, checked, continued, cut at gaps, and its rows as a Dataset has them."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

import forcegp.robots
from forcegp.data.configurations import following
from forcegp.data.dataset import BEYOND, LARGEST_MEASURED, SENSORS
from forcegp.data.views import ends_of_range
from forcegp.errors import DatasetError, FileFormatError, MistakenUnit
from forcegp.recordings.mapping import in_short, log_unit
from forcegp.recordings.ros_bag import Read, read_on_one_clock
from forcegp.recordings.signal_plan import Layout, SignalPlan, spans
from forcegp.recordings.source import Columns, Source
from forcegp.robots.manifold import POSITIONS, TURN, ConfigurationSpace

Values = Float[np.ndarray, "rows signals"]
Times = Float[np.ndarray, " rows"]
Marked = Bool[np.ndarray, " rows"]
Jumps = tuple[Int[np.ndarray, " jumps"], str, str]
"""Rows before which something moves too far, what was seen, and what to do."""
LARGEST_ERROR = 0.01  # of the length of a quaternion: more is no rounding
MOST_ROWS, LARGEST_STRETCH = 1_000_000, 20  # that even times make of a few rows, and of each
ROUNDED = 1e-9  # differences from length 1 beyond this are reported
MARGIN = 0.1
"""Of its range: how far a position may be beyond the limits of the URDF. Stops give way, and zeros are set by hand."""

TURNS = 4.0 * np.pi  # rad: positions of a joint beyond this whose unit is not stated as rad are taken for degrees
MOVES = 0.1
"""Of the range of joints in another unit: one within its limits that moves so far is right; one that rests fits any."""
REPEATED = 0.05
"""Of the median step: a stamp that comes sooner after another is the same one again; nothing is sampled so unevenly."""

GAP = 10.0
"""Median steps. A cubic spline through samples g apart misses at most 5/384 (2 pi f g)^4 of the amplitude of a sine of
frequency f (Hall & Meyer 1976): over 10 steps at 1 kHz 0.013 % at 5 Hz, 3 % at 20 Hz. Longer pauses end episodes."""

FEWEST_ROWS = 5  # of an episode: two derivatives by central differences need so many
SLOWEST, FASTEST = 2.0, 2e5
"""Rows per second beyond which a log of a robot is taken for one whose time is in another unit."""


@dataclass(frozen=True)
class Recording:
    """What was read of one table.

    `told` is what people should know; `signals` those that were logged, (rows, entries) in SI, in the order of a
    Dataset; `time` [s] from the first row on, whose stamp is `begin`; `jumps` rows before which something turns too
    far. `stretches`: episode and rows without gaps, `step` [s] their median step, `worst` the largest deviation of it.
    """

    told: dict[str, Any]
    source: Source
    signals: Mapping[str, Float[np.ndarray, "rows _"]]
    time: Times
    begin: float
    jumps: tuple[Jumps, ...]
    layout: Layout
    stretches: tuple[tuple[int, Int[np.ndarray, " _"]], ...]
    step: float
    worst: float

    def rows(self, used: Int[np.ndarray, " rows"], step: float | None) -> dict[str, np.ndarray]:
        """Time and the signals q, v, u, a of these rows, `step` [s] apart, or for None at the times of the log."""
        time, signals = self.time[used], {name: values[used] for name, values in self.signals.items()}
        if step is not None:
            stamps, held = time, list(self.layout.held)
            count = int(np.floor((stamps[-1] - stamps[0]) / step * (1 + 1e-12))) + 1
            if count > max(MOST_ROWS, LARGEST_STRETCH * len(stamps)):
                seen = f"{self.source.path}: {len(stamps)} rows would become {count:.3g}"
                raise DatasetError(f"{seen}; give a lower `rate`, or a shorter `gap` that ends an episode.")
            time = np.minimum(stamps[0] + step * np.arange(count), stamps[-1])
            before = np.searchsorted(stamps, time * (1 + 1e-12), side="right") - 1
            u = signals.get("u", np.zeros((len(stamps), 0)))[before]
            signals = {name: make_interp_spline(stamps, values, k=3)(time) for name, values in signals.items()}
            if held:
                signals["u"][:, held] = u[:, held]
        return {"time": time, **self.layout.signals(signals, time)}


def read_recording(
    source: Source, plan: SignalPlan, label: str, options: Any, robot: forcegp.robots.Robot, believed: Collection[str]
) -> Recording:
    """Read a table as the `ImportOptions` say; `believed` joints may turn often.

    Raises FileFormatError and DatasetError naming the file, the row, the time and the column.
    """
    if not plan.columns:
        raise FileFormatError(f"{label} has no rows; give a log with rows.")
    source.lenient = options.bad_rows == "skip"
    read = read_on_one_clock(source, plan)
    columns = read.columns
    rows = len(columns[plan.columns[0]])
    values = np.stack([item.value(columns, rows) for item in plan.signals], axis=1)
    for row, column in np.argwhere((np.abs(values) > LARGEST_MEASURED) & np.isfinite(values))[:1]:
        item, where = plan.signals[column], f"{values[row, column]:g} at {source.place(int(row))}"
        seen = f"{source.path}: column {item.expression.text!r} ({item.signal} of joint {item.joint!r}) is {where}"
        raise DatasetError(f"{seen}, {BEYOND} Map another column, state its `unit`, or repair these rows.")
    lost = _lost(label, plan, columns, values, skip=options.bad_rows == "skip")
    skipped = [f"rows left out because they lack a value: {lost.sum()} of {rows}"] if lost.any() else []
    skipped += _at_ends(plan, values, lost)
    derived, unlogged = _unlogged(plan, values)
    if lost.any():  # stand-ins that nobody sees: the rows before them
        good = np.where(lost, np.argmin(lost), np.arange(rows))
        columns = {name: column[np.maximum.accumulate(good)] for name, column in columns.items()}
        values = values[np.maximum.accumulate(good)]
    time, begin = _seconds(plan, source, columns, rows)
    _require_finite(values, columns, plan, source, time)
    episodes = np.zeros((1, 2), np.int64) if plan.episode is None else _episodes(columns[plan.episode], source)
    jumps = _continued(plan, values, episodes[:, 1], options.unwrap)
    if not options.beyond_limits:
        _require_plausible_positions(label, values, plan, robot, believed)
    signals = {name: values[:, [item.signal == name for item in plan.signals]] for name in plan.logged}
    signals["q"], turned, told = read_poses(plan.layout.space, plan.orientation, source, signals["q"], episodes[:, 1])
    layout = replace(plan.layout, held=read.held or plan.layout.held, derived=derived)
    stretches, step, worst, left_out = _stretches(label, source, time, episodes, replace(read, lost=lost), options)
    seconds = float(sum(np.ptp(time[rows]) for _, rows in stretches))
    about = {"name": label, "rows": rows, "seconds": seconds, "median_step": step, "largest_deviation_of_a_step": worst}
    about |= {**left_out, "notes": [*read.notes, *unlogged, *skipped, *told]}
    return Recording(about, source, signals, time, begin, (*jumps, *turned), layout, stretches, step, worst)


def _unlogged(plan: SignalPlan, values: Values) -> tuple[dict[str, list[int]], list[str]]:
    """Entries of v and a to be derived, those that hold no number at all among them, which become 0; and remarks."""
    derived, notes = {name: list(rows) for name, rows in plan.layout.derived.items()}, list[str]()
    for name in ("v", "a"):
        own = [column for column, item in enumerate(plan.signals) if item.signal == name]
        empty = [row for row, column in enumerate(own) if np.isnan(values[:, column]).all()]
        if empty and (len(empty) == len(own) or plan.layout.space.is_vector_space):
            values[:, [own[row] for row in empty]] = 0.0
            derived[name] = sorted({*empty, *derived.get(name, ())})
            joints = ", ".join(plan.signals[own[row]].joint for row in empty)
            notes.append(f"every {name} of {joints} is missing, so it is derived (--{name} derive)")
    return derived, notes


def _lost(label: str, plan: SignalPlan, columns: Columns, values: Values, *, skip: bool) -> Marked:
    """Rows to leave out: those without any value, and with `skip` those without one of them or without a stamp."""
    missing = np.logical_not(np.isfinite(values))
    there = ~missing.all(axis=0)  # what the log lacks throughout is no loss of rows
    measured = there & np.array([bool(item.expression.weights) for item in plan.signals])
    lost = np.array(missing[:, measured].all(axis=1))
    if skip:
        lost = np.array(missing[:, there].any(axis=1))
        for name in (*(plan.time.weights if plan.time else ()), *([plan.episode] if plan.episode else ())):
            lost |= ~np.isfinite(columns[name])
    count, rows, most = int(lost.sum()), len(values), Source.MOST_LOST
    if skip and count > most * rows:
        seen = f"{label}: {count} of {rows} rows lack a value, and `bad_rows` skip leaves out {most:.0%} at most"
        raise DatasetError(f"{seen}. Map other columns, or repair the log.")
    return lost if count <= most * rows else np.zeros(rows, bool)  # then the first value that is missing is named


def _at_ends(plan: SignalPlan, values: np.ndarray, lost: Marked) -> list[str]:
    """Marks rows in which a sensor stays at an end of its range as lost, and says so."""
    sensors, notes = np.array([item.signal.startswith(SENSORS) for item in plan.signals]), list[str]()
    changes = np.r_[False, (np.diff(values[:, ~sensors], axis=0) != 0.0).any(1)] & ~lost
    for k in np.flatnonzero(sensors):
        for extreme, there in ends_of_range(values[:, k], changes):
            if extreme != 0.0:  # there nothing touches it
                lost |= there
                end = f"{plan.signals[k].signal} ({plan.signals[k].joint}) stays at {extreme:.5g}, an end of its range"
                notes.append(f"{end}: {there.sum()} rows left out; `trim` their edges")
    return notes


def _seconds(plan: SignalPlan, source: Source, columns: Columns, rows: int) -> tuple[np.ndarray, float]:
    """Seconds since the first row, and its stamp in s; whole numbers are subtracted as such, to the last ns."""
    if plan.time is None:
        assert plan.step is not None
        return np.arange(rows) * plan.step, 0.0
    name = next(iter(plan.time.weights))
    whole = plan.time.is_column and columns[name].dtype == np.int64
    raw = columns[name] if whole else plan.time.value(columns, rows)
    if not whole and not np.isfinite(raw).all():
        row = int(np.argmin(np.isfinite(raw)))
        seen = f"{source.path}: column {name!r}, the time, is {_shown(raw[row])} at {source.place(row)}"
        raise DatasetError(f"{seen}. Repair or remove that row.")
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


def read_poses(
    space: ConfigurationSpace, orientation: str, source: Source, table: Values, begins: Int[np.ndarray, " episodes"]
) -> tuple[Float[np.ndarray, "rows nq"], list[Jumps], list[str]]:
    """Positions as the log writes them, as q: turns of length 1, quaternions whose sign never jumps.

    And rows before which a base turns by more than a quarter of a turn, `begins` of episodes left out; and what people
    should know. Raises DatasetError, naming the row, where a turn is more than 1 % longer or shorter than 1.
    """
    turned = list(spans(space, orientation))
    q = np.delete(table, [column for _, span in turned for column in range(span.start, span.stop)], axis=1)
    jumps, notes = list[Jumps](), list[str]()
    for group, span in turned:
        given, first = table[:, span], TURN.start
        if orientation == "angles":
            turn = np.array(Rotation.from_euler("xyz", given[:, first:]).as_quat())
        else:
            length = np.linalg.norm(given[:, first:], axis=1, keepdims=True)
            error = np.abs(length[:, 0] - 1.0)
            row = int(error.argmax())
            if error[row] > LARGEST_ERROR:
                names = ", ".join(POSITIONS[TURN])
                where = f"({names}) has the length {length[row, 0]:.4g} at {source.place(row)}"
                angles = "give `orientation` angles if they are roll, pitch and yaw"
                advice = f"a turn has length 1. Map its columns, {angles}, or repair or remove these rows."
                raise DatasetError(f"{source.path}: the orientation of {group.name!r} {where}; {advice}")
            if error[row] > ROUNDED:
                notes.append(f"orientations divided by their length, which differs from 1 by up to {error[row]:.2g}")
            turn = given[:, first:] / length
        turn, jumped = following(turn, turn[0])
        jumped[begins] = False
        seen = f"{group.name!r} turns by more than a quarter of a turn"
        unit = "the unit of its angles (`unit` q=deg)"
        remedy = f"give the order of its columns (`orientation`), {unit}, or leave it out."
        jumps.append((np.flatnonzero(jumped), seen, remedy))
        q = np.hstack([q[:, : group.place], given[:, :first], turn, q[:, group.place :]])
    return q, jumps, notes


def _require_finite(values: np.ndarray, columns: Columns, plan: SignalPlan, source: Source, time: Times) -> None:
    if np.isfinite(values).all():
        return
    row, index = (int(position) for position in np.argwhere(~np.isfinite(values))[0])
    item = plan.signals[index]
    wrong = [name for name in item.expression.weights if not np.isfinite(columns[name][row])]
    name, value = (wrong[0], columns[wrong[0]][row]) if wrong else (item.expression.text, values[row, index])
    seen = f"{source.path}: column {name!r} ({item.signal} of joint {item.joint!r}) is {_shown(value)}"
    where = f"{source.place(row)}, {time[row]:.6g} s from the start; {int((~np.isfinite(values)).sum())} such values"
    advice = "Repair these rows, map another column, or leave such rows out by `bad_rows` skip."
    raise DatasetError(f"{seen} at {where}. {advice}")


def _shown(value: float) -> str:
    return "missing (empty or NaN)" if np.isnan(value) else f"{value}"


def _episodes(column: np.ndarray, source: Source) -> Int[np.ndarray, "n 2"]:
    numbers = np.asarray(column, dtype=np.float64)
    odd = ~np.isfinite(numbers) | (numbers != np.round(numbers))
    if odd.any():
        row = int(np.argmax(odd))
        raise DatasetError(f"{source.path}: the episode is {numbers[row]} at {source.place(row)}, not a whole number.")
    starts = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1.0))
    own = numbers[starts].astype(np.int64)
    again = np.setdiff1d(np.arange(len(own)), np.unique(own, return_index=True)[1])
    if len(again):
        seen = f"{source.path}: episode {own[again[0]]} begins again at {source.place(int(starts[again[0]]))}"
        raise DatasetError(f"{seen}; rows of an episode must lie together. Sort the log by episode and time.")
    return np.stack([own, starts], axis=1)


def _require_plausible_positions(
    label: str, values: Values, plan: SignalPlan, robot: forcegp.robots.Robot, believed: Collection[str]
) -> None:
    """Refuse positions far beyond the limits of the URDF; without limits, those that look like degrees."""
    limits = {joint.name: (joint.lower, joint.upper) for joint in robot.joints}
    own = {x.joint: (x.unit.name, y) for x, y in zip(plan.signals, values.T, strict=True) if x.signal == "q"}
    units, ranges, seen = dict[str, str](), {name: float(np.ptp(x)) for name, (_, x) in own.items()}, dict[str, str]()
    for name, (unit, column) in own.items():
        low, high = float(column.min()), float(column.max())
        lower, upper = limits.get(name, (-np.inf, np.inf))
        margin = MARGIN * (upper - lower) if np.isfinite(upper - lower) else 0.0
        least, most = lower - margin, upper + margin
        degrees = unit == "rad" and max(-low, high) > TURNS
        where = f"{label}: q of joint {name!r} runs from {low:.4g} to {high:.4g} {log_unit('q', unit).si}"
        units[name] = "deg" if degrees else "mm" if unit == "m" and least <= 1e-3 * low <= 1e-3 * high <= most else unit
        if low < least or high > most:
            seen[name] = f"{where}, beyond its limits {lower:.4g} to {upper:.4g} in the URDF."
        elif degrees and name not in believed and not np.isfinite(upper - lower):
            seen[name] = f"{where}, more than two turns."
        else:
            units[name], ranges[name] = unit, ranges[name] if np.isfinite(upper - lower) else 0.0
    for meant in {log_unit("q", units[name]) for name in seen if units[name] != own[name][0]}:
        usual = np.median([ranges[name] for name in seen if units[name] == meant.name]) / meant.per_si
        alike = [x for x in units if units[x] == meant.si and (x in seen or ranges[x] < MOVES * usual)]
        units |= dict.fromkeys(alike, meant.name)
    stated = ",".join(in_short("q", [units[name] for name in plan.positions]))
    for name, what in seen.items():
        if units[name] == own[name][0]:
            raise DatasetError(f"{what} Are unit, sign, zero and URDF right? `beyond_limits` accepts it.")
        sure = not what.endswith("two turns.")
        hint = f"Is it in {units[name]}? Then add `unit` q={stated}. `beyond_limits` accepts it."
        if not sure:
            hint = f"Give `unit` q={stated} if it is in deg, `unit` q=rad if not."
        raise MistakenUnit(f"{what} {hint}", "q", stated, sure)


def _stretches(
    label: str, source: Source, time: Times, episodes: np.ndarray, read: Read, options: Any
) -> tuple[tuple[tuple[int, np.ndarray], ...], float, float, dict[str, Any]]:
    """Rows between gaps, their median step, the worst relative deviation from it, and what was left out.

    Of rows with the same stamp the first is kept. DatasetError for time that runs backwards and impossible rates.
    """
    begins, steps = episodes[:, 1], np.diff(time)
    steps[begins[begins > 0] - 1] = np.nan
    backwards = np.flatnonzero(steps < 0)
    if backwards.size:
        row = int(backwards[0]) + 1
        where = f"{source.place(row)} ({time[row]:.6g} s from the start), {backwards.size} times in all"
        seen = f"{label}: time runs backwards by {-steps[row - 1]:.6g} s at {where}"
        advice = "map another column as the time, or name the column that numbers its episodes (`episode`)."
        raise DatasetError(f"{seen}. Sort the log, {advice}")
    positive = steps[steps > 0]
    if len(time) < FEWEST_ROWS:
        raise DatasetError(f"{label} has {len(time)} rows; an episode has at least {FEWEST_ROWS}.")
    if not positive.size:
        raise DatasetError(f"{label}: all rows have the same time stamp; map another column as the time.")
    typical = float(np.median(positive))
    _require_rate(label, typical)
    kept = ~read.lost
    kept[kept] = np.diff(time[kept], prepend=-np.inf) >= REPEATED * typical
    kept[begins] = ~read.lost[begins]
    repeated, since = int((~read.lost & ~kept).sum()), time - np.repeat(time[begins], np.diff([*begins, len(time)]))
    start, end = -np.inf if options.start is None else options.start, np.inf if options.end is None else options.end
    kept &= (since >= start) & (since <= end) & (np.searchsorted(options.without, since) % 2 == 0)
    if not kept.any():
        raise DatasetError(f"{label}: `start`, `end` and `without` leave no row of its {since.max():.6g} s.")
    paused = read.paused(options.gap, GAP)
    used = np.flatnonzero(kept & ~paused)
    number = np.searchsorted(begins, used, side="right") - 1
    same, between = np.diff(number) == 0, np.diff(time[used])
    step = float(np.median(between[same])) if same.any() else typical
    limit = GAP * step if options.gap is None else options.gap
    inside = same & (between <= limit) & (np.diff(np.cumsum(paused)[used]) == 0)
    pieces = np.split(np.arange(len(used)), np.flatnonzero(~inside) + 1)
    stretches = [(int(episodes[number[own[0]], 0]), used[own]) for own in pieces if len(own) >= FEWEST_ROWS]
    if not stretches:
        seen = f"{label}: no {FEWEST_ROWS} rows lie together without a gap of more than {limit:.6g} s"
        raise DatasetError(f"{seen}; a longer `gap` may be right.")
    worst = float(np.abs(between[inside] / step - 1.0).max())
    left_out = {"repeated_stamps_dropped": repeated, "gaps": between[same & ~inside].tolist()}
    left_out["rows_in_stretches_too_short"] = len(used) - sum(len(rows) for _, rows in stretches)
    return tuple(stretches), step, worst, left_out


def _require_rate(label: str, step: float) -> None:
    rate = 1.0 / step
    if SLOWEST <= rate <= FASTEST:
        return
    seen = f"{label}: the median step is {step:.6g} s, {rate:.3g} rows per second, no rate of a robot's log."
    if rate > FASTEST:
        hint = "Is the time in s rather than in a smaller unit? Then add `unit` time=s."
        raise MistakenUnit(f"{seen} {hint}", "time", "s")
    fitting = [unit for unit, factor in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)) if 10.0 <= rate * factor <= 2e4]
    if fitting:
        hint = f"Is the time in {' or '.join(fitting)}? Then add `unit` time={fitting[0]}."
        raise MistakenUnit(f"{seen} {hint}", "time", fitting[0])
    raise DatasetError(f"{seen} Map another column as the time.")
