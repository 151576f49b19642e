"""The stamps of a recording, the stretches between its gaps, and their rows as a Dataset has them."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Int
from scipy.interpolate import make_interp_spline

from forcegp.data.filtering import JITTER
from forcegp.errors import DatasetError, MistakenUnit
from forcegp.recordings.moving_base import Layout
from forcegp.recordings.reading import RawRecording

REPEATED = 0.05
"""Of the median step: a stamp that comes sooner after another is the same one again; nothing is sampled so unevenly."""

GAP = 10.0
"""Median steps. A cubic spline through samples g apart misses at most 5/384 (2 pi f g)^4 of the amplitude of a sine of
frequency f (Hall & Meyer 1976): across 10 steps at 1 kHz 0.013 % at 5 Hz and 3 % at 20 Hz. Longer pauses end an
episode."""

FEWEST_ROWS = 5
"""Of an episode: two derivatives by central differences need so many."""

SLOWEST, FASTEST = 2.0, 2e5
"""Rows per second beyond which a log of a robot is taken for one whose time is in another unit."""


@dataclass(frozen=True)
class Stretch:
    """Numbers of the rows of a recording that are used, without gap; `number` is the log's episode."""

    rows: Int[np.ndarray, " rows"]
    number: int


@dataclass(frozen=True)
class Stamps:
    """The stamps of one recording.

    `step` is the median of the steps between rows that are used [s]; `worst` the largest relative deviation of a step
    within a stretch from it.
    """

    stretches: tuple[Stretch, ...]
    step: float
    worst: float
    repeated: int
    gaps: tuple[float, ...]
    dropped_rows: int

    @property
    def even(self) -> bool:
        """Is every step within 1 % of the median?"""
        return self.worst <= JITTER


def read_stamps(recording: RawRecording, gap: float | None, start: float | None, end: float | None) -> Stamps:
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
    paused = recording.source.paused(gap, GAP)
    paused = np.zeros(len(kept), bool) if paused is None else paused
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
        stretches.append(Stretch(used[first:last], int(recording.episodes[number[first], 0])))
    if not stretches:
        raise DatasetError(
            f"{recording.label}: no {FEWEST_ROWS} rows lie together without a gap of more than {limit:.6g} s; "
            "a longer `gap` may be right."
        )
    gaps = tuple(between[same & ~inside].tolist())
    worst = float(np.abs(between[inside] / step - 1.0).max())
    return Stamps(tuple(stretches), step, worst, repeated, gaps, dropped)


def _typical_step(recording: RawRecording) -> float:
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


def _between(recording: RawRecording, start: float | None, end: float | None) -> np.ndarray:
    """Rows from `start` to `end` seconds after the first of their episode. Raises DatasetError if there is none."""
    begins = recording.episodes[:, 1]
    counts = np.diff([*begins, len(recording.time)])
    since = recording.time - np.repeat(recording.time[begins], counts)
    inside = (since >= (-np.inf if start is None else start)) & (since <= (np.inf if end is None else end))
    if not inside.any():
        raise DatasetError(f"{recording.label}: no row lies between `start` and `end`; it has {since.max():.6g} s.")
    return inside


def _require_rate(recording: RawRecording, step: float) -> None:
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


def episode_rows(
    recording: RawRecording, used: Int[np.ndarray, " rows"], layout: Layout, step: float | None
) -> dict[str, np.ndarray]:
    """Time and the signals q, v, u, a of these rows, `step` [s] apart, or for None at the times of the log."""
    time, signals = recording.time[used], {name: values[used] for name, values in recording.signals.items()}
    if step is not None:
        stamps, held = time, list(layout.held)
        count = int(np.floor((stamps[-1] - stamps[0]) / step * (1 + 1e-12))) + 1
        time = np.minimum(stamps[0] + step * np.arange(count), stamps[-1])
        before = np.searchsorted(stamps, time * (1 + 1e-12), side="right") - 1
        u = signals.get("u", np.zeros((len(stamps), 0)))[before]
        signals = {name: make_interp_spline(stamps, values, k=3)(time) for name, values in signals.items()}
        if held:
            signals["u"][:, held] = u[:, held]
    return {"time": time, **layout.signals(signals, time)}
