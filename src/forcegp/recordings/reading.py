"""One recording from a log into the spool: columns evaluated, checked for values that make no sense, and set aside."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

import forcegp.robots
from forcegp.errors import DatasetError, DataWarning, FileFormatError, MistakenUnit
from forcegp.recordings.moving_base import MOST_JUMPS, Poses
from forcegp.recordings.signal_plan import JointSignal, SignalPlan
from forcegp.recordings.source import Columns, Source
from forcegp.recordings.turns import TURN, turns_to_add


class Spool:
    """A table of float64 in a file without a name, which is gone with the process whatever ends it.

    Rows are appended in blocks and read back by number; memory holds only what is read. Rates and gaps are known only
    after the last row, and reading most formats costs more than everything after it, so a log is read once; the result
    then depends neither on its format nor on the size of the pieces that a reader gives.
    """

    def __init__(self, folder: Path, width: int) -> None:
        self.width = width
        self.rows = 0
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # closed by __exit__

    def __enter__(self) -> Spool:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, table: Float[np.ndarray, "rows width"]) -> None:
        """Put rows at the end."""
        self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(table, dtype=np.float64).data)
        self.rows += len(table)

    def read(self, start: int, end: int) -> Float[np.ndarray, "rows width"]:
        """Rows start to end, the latter excluded, as an array of its own."""
        self._file.seek(start * self.width * 8)
        data = self._file.read((end - start) * self.width * 8)
        return np.frombuffer(data, np.float64).reshape(-1, self.width)

    def column(self, start: int, end: int, place: int) -> Float[np.ndarray, " rows"]:
        """One column of rows start to end."""
        return np.concatenate([self.read(row, next_)[:, place] for row, next_ in _pieces(start, end)])

    def add(self, start: int, end: int, place: int, values: Float[np.ndarray, " rows"]) -> None:
        """Add values to one column of rows start to end."""
        for row, next_ in _pieces(start, end):
            table = self.read(row, next_).copy()
            table[:, place] += values[row - start : next_ - start]
            self._file.seek(row * self.width * 8)
            self._file.write(table.data)


ROWS_AT_A_TIME = 16384


def _pieces(start: int, end: int) -> Iterator[tuple[int, int]]:
    return ((row, min(row + ROWS_AT_A_TIME, end)) for row in range(start, end, ROWS_AT_A_TIME))


@dataclass(frozen=True)
class RawRecording:
    """What was read of one table.

    Fields
    ------
    label: what people call it, a file or an array in it.
    first: its first row in the spool.
    time: (rows,) [s] from its first row on.
    begin: the stamp of the log at the first row, in s.
    episodes: (n, 2) episode number of the log and row at which it begins; one row if the log numbers none.
    lowest, highest: (signals,) of each signal of the plan, in SI.
    jumps: rows before which a turning joint moves by more than half a turn, or a base by a quarter; what was
        seen, and what to do.
    notes: on the orientations of a base, and angles that step by more than half a turn.
    """

    label: str
    source: Source
    first: int
    time: Float[np.ndarray, " rows"]
    begin: float
    episodes: Int[np.ndarray, "n 2"]
    lowest: Float[np.ndarray, " signals"]
    highest: Float[np.ndarray, " signals"]
    jumps: tuple[tuple[int, str, str], ...]
    notes: tuple[str, ...] = ()


def read_recording(
    source: Source, plan: SignalPlan, spool: Spool, label: str, *, unwrap: bool, most_rows: int
) -> RawRecording:
    """Read a table once. Raises FileFormatError and DatasetError naming the file, the row, the time and the column."""
    first = spool.rows
    clock = _Clock(plan, source)
    turns = _Turns(plan)
    poses = Poses(plan.layout.space, plan.orientation, source)
    positions = sum(item.signal == "q" for item in plan.signals)
    times: list[np.ndarray] = []
    episodes: list[tuple[int, int]] = []
    lowest = np.full(len(plan.signals), np.inf)
    highest = -lowest
    rows = 0
    for columns in source.chunks(plan.columns, ROWS_AT_A_TIME) if plan.columns else ():
        count = len(next(iter(columns.values())))
        if rows + count > most_rows:
            raise FileFormatError(f"{label} has more than {most_rows} rows; allow more with `most_rows`.")
        times.append(clock.seconds(columns, rows, count))
        table = np.empty((count, len(plan.signals)))
        for index, item in enumerate(plan.signals):
            table[:, index] = item.value(columns, count)
        _require_finite(table, columns, plan, source, rows, times[-1])
        if plan.episode is not None:
            _note_episodes(columns[plan.episode], episodes, source, rows)
        restarts = [row - rows for _, row in episodes if row >= rows]
        turns.follow(table, rows, restarts)
        lowest, highest = np.minimum(lowest, table.min(axis=0)), np.maximum(highest, table.max(axis=0))
        q = poses.read(table[:, :positions], rows, restarts)
        spool.append(np.hstack([q, table[:, positions:]]))
        rows += count
    if rows == 0:
        raise FileFormatError(f"{label} has no rows; give a log with rows.")
    begins = np.asarray(episodes or [(0, 0)], dtype=np.int64)
    time = np.concatenate(times)
    if unwrap:
        jumps, notes = turns.continued(spool, first, time, begins[:, 1], lowest, highest)
    else:
        jumps, notes = turns.refused(), ()
    notes, jumps = (*poses.note(), *notes), (*jumps, *poses.jumps)
    return RawRecording(label, source, first, time, clock.begin, begins, lowest, highest, jumps, notes)


class _Clock:
    """Seconds since the first row. Whole numbers are subtracted as such: a float64 has no epochs in ns to 1 ns."""

    def __init__(self, plan: SignalPlan, source: Source) -> None:
        self.plan, self.source = plan, source
        self.origin: int | float | None = None
        self.begin = 0.0

    def seconds(self, columns: Columns, rows: int, count: int) -> np.ndarray:
        plan = self.plan
        if plan.time is None:
            assert plan.step is not None
            return np.arange(rows, rows + count) * plan.step
        name = next(iter(plan.time.weights))
        whole = plan.time.is_column and columns[name].dtype == np.int64
        raw = columns[name] if whole else plan.time.value(columns, count)
        if not whole and not np.isfinite(raw).all():
            row = int(np.argmin(np.isfinite(raw)))
            raise DatasetError(
                f"{self.source.path}: column {name!r}, the time, is {_shown(raw[row])} at "
                f"{self.source.place(rows + row)}. Repair or remove that row."
            )
        if self.origin is None:
            self.origin = raw[0]
            self.begin = float(plan.time_unit.in_si(np.asarray([raw[0]], dtype=np.float64))[0])
        return plan.time_unit.in_si((raw - self.origin).astype(np.float64))


class _Turns:
    """Positions of turning joints: where they step by more than half a turn, and which of them then wrap."""

    def __init__(self, plan: SignalPlan) -> None:
        self.plan = plan
        angles = [item.signal == "q" and item.unit.si == "rad" for item in plan.signals]
        self.columns = [i for i, turns in enumerate(angles) if turns and plan.signals[i].joint in plan.joints]
        self.last: np.ndarray | None = None
        self.jumps: list[tuple[int, int]] = []
        self.jumped = np.zeros(len(self.columns), dtype=bool)

    def follow(self, table: np.ndarray, rows: int, restarts: list[int]) -> None:
        """Note where the positions jump; rows in `restarts` begin another episode."""
        q = table[:, self.columns]
        before = q[:1] if self.last is None else self.last[None, :]
        steps = np.diff(np.concatenate([before, q]), axis=0)
        steps[restarts] = 0.0
        self.last = q[-1].copy()
        jumps = np.abs(steps) > np.pi
        self.jumped |= jumps.any(axis=0)
        self.jumps += [(rows + int(row), int(index)) for row, index in np.argwhere(jumps)[:MOST_JUMPS]]

    def refused(self) -> list[tuple[int, str, str]]:
        """All jumps, for `RawRecording`."""
        remedy = "the angle wraps, or is in degrees. Add `unwrap`, or `unit` q=deg."
        return [(row, f"{self._name(index)} jumps by more than half a turn", remedy) for row, index in self.jumps]

    def continued(
        self, spool: Spool, first: int, time: np.ndarray, begins: np.ndarray, lowest: np.ndarray, highest: np.ndarray
    ) -> tuple[list[tuple[int, str, str]], list[str]]:
        """Add whole turns to the angles that wrap: in the spool, to `lowest` and to `highest`.

        Returns the jumps about which nothing decides, and notes on angles that wrap or count turns.
        """
        layout, end = self.plan.layout, first + len(time)
        single = [self.plan.joints[row] for row in layout.space.single_rows]
        places = dict(
            zip(single, layout.space.singles(torch.arange(float(layout.space.nq))).int().tolist(), strict=True)
        )
        remedy = "nothing shows whether it wraps or counts turns. Map its velocity (`v`), or mend these rows."
        jumps, notes = list[tuple[int, str, str]](), list[str]()
        for index in map(int, np.flatnonzero(self.jumped)):
            joint = self.plan.signals[self.columns[index]].joint
            place = layout.places["q"].start + places[joint]
            q, v = spool.column(first, end, place), None
            if "v" in layout.places:
                v = spool.column(first, end, layout.places["v"].start + self.plan.joints.index(joint))
            turns, undecided = turns_to_add(q, time, v, begins)
            seen = f"{self._name(index)} jumps by more than half a turn"
            jumps += [(int(row), seen, remedy) for row in undecided[:MOST_JUMPS]]
            if turns.any():
                spool.add(first, end, place, TURN * turns)
                q += TURN * turns
                lowest[self.columns[index]], highest[self.columns[index]] = q.min(), q.max()
            elif not len(undecided):
                notes.append(f"{self._name(index)} counts turns: steps of more than half a turn stay")
        return jumps, notes

    def _name(self, index: int) -> str:
        return f"q of joint {self.plan.signals[self.columns[index]].joint!r}"


def _require_finite(
    table: np.ndarray, columns: Columns, plan: SignalPlan, source: Source, rows: int, times: np.ndarray
) -> None:
    if np.isfinite(table).all():
        return
    row, index = (int(position) for position in np.argwhere(~np.isfinite(table))[0])
    item: JointSignal = plan.signals[index]
    wrong = [name for name in item.expression.weights if not np.isfinite(columns[name][row])]
    name = wrong[0] if wrong else next(iter(item.expression.weights), "")
    raise DatasetError(
        f"{source.path}: column {name!r} ({item.signal} of joint {item.joint!r}) is {_shown(columns[name][row])} at "
        f"{source.place(rows + row)}, {times[row]:.6g} s from the start; {int((~np.isfinite(table)).sum())} such "
        "values in this part. Repair or remove these rows, or map another column."
    )


def _shown(value: float) -> str:
    return "missing (empty or NaN)" if np.isnan(value) else f"{value}"


def _note_episodes(column: np.ndarray, episodes: list[tuple[int, int]], source: Source, rows: int) -> None:
    """Append (number, row) for every row at which another episode begins."""
    numbers = np.asarray(column, dtype=np.float64)
    if not np.isfinite(numbers).all() or (numbers != np.round(numbers)).any():
        row = int(np.argmax(~np.isfinite(numbers) | (numbers != np.round(numbers))))
        raise DatasetError(
            f"{source.path}: the episode is {numbers[row]} at {source.place(rows + row)}, not a whole number."
        )
    starts = np.flatnonzero(np.diff(numbers)) + 1
    if not episodes or episodes[-1][0] != int(numbers[0]):
        starts = np.concatenate([[0], starts])
    seen = {number for number, _ in episodes}
    for start in starts:
        number = int(numbers[start])
        if number in seen:
            raise DatasetError(
                f"{source.path}: episode {number} begins again at {source.place(rows + int(start))}; rows of an "
                "episode must lie together. Sort the log by episode and time."
            )
        seen.add(number)
        episodes.append((number, rows + int(start)))


BEYOND = 0.1
"""Of its range: how far a position may be beyond the limits of the URDF. Stops give way, and zeros are set by hand."""

TURNS = 4.0 * np.pi
"""rad: positions of a joint beyond this whose unit is not stated as rad are taken for degrees."""

STRONGER = 3.0
"""Times the limit of the URDF that a force may be before it is warned of."""


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
        low, high = recording.lowest[index], recording.highest[index]
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
        if degrees and item.joint not in believed and not np.isfinite(upper - lower):
            hint = "Give `unit` q=deg if it is in degrees, `unit` q=rad if not."
            raise MistakenUnit(f"{where}, more than two turns. {hint}", "q", "deg")


def warn_of_implausible_forces(recording: RawRecording, plan: SignalPlan, robot: forcegp.robots.Robot | None) -> None:
    """Warn (DataWarning) of forces far beyond the limits of the URDF."""
    limits = {} if robot is None else {joint.name: joint.effort_limit for joint in robot.joints}
    for index, item in enumerate(plan.signals):
        limit = limits.get(item.joint, np.inf)
        most = float(max(-recording.lowest[index], recording.highest[index]))
        if item.signal == "u" and 0.0 < limit < np.inf and most > STRONGER * limit:
            warnings.warn(
                f"{recording.label}: u of joint {item.joint!r} reaches {most:.4g} {item.unit.si}; the URDF allows "
                f"{limit:.4g}. Is it in another unit (`unit` u=mNm), or on the motor's side of a gear (`scale`)?",
                DataWarning,
                stacklevel=2,
            )
