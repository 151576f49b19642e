"""What the stamps of a recording say: order, repeated stamps, gaps, rate, and the stretches that become episodes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float

from forcegp.data.filtering import JITTER
from forcegp.errors import DatasetError
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
    """Rows of a recording without gap: [start, end), counted in the recording; `number` is the log's episode."""

    recording: RawRecording
    start: int
    end: int
    number: int


@dataclass(frozen=True)
class Stamps:
    """The stamps of one recording.

    `kept` (rows,) are the rows that are used; `step` is the median of the steps between them [s]; `steps` are these
    steps within stretches; `worst` the largest relative deviation of one from the median.
    """

    __no_type_check__: ClassVar[bool] = True

    stretches: tuple[Stretch, ...]
    kept: Bool[np.ndarray, " rows"]
    step: float
    steps: Float[np.ndarray, " steps"]
    repeated: int
    gaps: tuple[float, ...]
    dropped_rows: int

    @property
    def worst(self) -> float:
        """Largest relative deviation of a step from the median step."""
        return float(np.abs(self.steps / self.step - 1.0).max())

    @property
    def even(self) -> bool:
        """Is every step within 1 % of the median?"""
        return self.worst <= JITTER


def read_stamps(recording: RawRecording, gap: float | None, start: float | None, end: float | None) -> Stamps:
    """Stretches of a recording between gaps of more than `gap` seconds (default `GAP` median steps).

    Of rows with the same stamp the first is kept: what comes after it is a sample that was sent again, or one whose
    time is not known. `start` and `end` [s] are counted from the first row of each episode.
    Raises DatasetError for time that runs backwards, and for rates that no robot is logged at.
    """
    time = recording.time
    begins = recording.episodes[:, 1]
    steps = np.diff(time)
    inner = np.ones(len(steps), bool)
    inner[begins[begins > 0] - 1] = False
    _require_order(recording, steps, inner)
    positive = steps[inner & (steps > 0)]
    if not positive.size:
        raise DatasetError(f"{recording.label}: all rows have the same time stamp; map another column as the time.")
    _require_rate(recording, float(np.median(positive)))
    kept = _first_of_each(time, begins, REPEATED * float(np.median(positive)))
    repeated = int((~kept).sum())
    used = np.flatnonzero(kept)
    number = np.searchsorted(begins, used, side="right") - 1
    since = time[used] - time[begins[number]]
    inside = np.ones(len(used), bool)
    if start is not None:
        inside &= since >= start
    if end is not None:
        inside &= since <= end
    used, number = used[inside], number[inside]
    if not used.size:
        raise DatasetError(f"{recording.label}: no row lies between --start and --end; it has {since.max():.6g} s.")
    kept[:] = False
    kept[used] = True
    between = np.diff(time[used])
    same = np.diff(number) == 0
    typical = between[same]
    step = float(np.median(typical)) if typical.size else float(np.median(positive))
    limit = GAP * step if gap is None else gap
    cuts = np.flatnonzero(~same | (between > limit)) + 1
    bounds = [0, *cuts.tolist(), len(used)]
    stretches, dropped = [], 0
    for first, last in pairwise(bounds):
        if last - first < FEWEST_ROWS:
            dropped += last - first
            continue
        own = int(recording.episodes[number[first], 0])
        stretches.append(Stretch(recording, int(used[first]), int(used[last - 1]) + 1, own))
    if not stretches:
        raise DatasetError(
            f"{recording.label}: no {FEWEST_ROWS} rows lie together without a gap of more than {limit:.6g} s; "
            "a longer --gap may be right."
        )
    inside_stretches = between[same & (between <= limit)]
    gaps = tuple(float(value) for value in between[same & (between > limit)])
    return Stamps(tuple(stretches), kept, step, inside_stretches, repeated, gaps, dropped)


def _require_order(recording: RawRecording, steps: np.ndarray, inner: np.ndarray) -> None:
    backwards = np.flatnonzero(inner & (steps < 0))
    if backwards.size:
        row = int(backwards[0]) + 1
        raise DatasetError(
            f"{recording.label}: time runs backwards by {-steps[row - 1]:.6g} s at {recording.source.place(row)} "
            f"({recording.time[row]:.6g} s from the start), {backwards.size} times in all. Sort the log, map another "
            "column as the time, or name the column that numbers its episodes (--episode)."
        )


def _require_rate(recording: RawRecording, step: float) -> None:
    rate = 1.0 / step
    if SLOWEST <= rate <= FASTEST:
        return
    factors = {"ms": 1e3, "us": 1e6, "ns": 1e9}
    hint = "Map another column as the time."
    if rate < SLOWEST:
        fitting = [unit for unit, factor in factors.items() if 10.0 <= rate * factor <= 2e4]
        if fitting:
            hint = f"Is the time in {' or '.join(fitting)}? Then add --unit time={fitting[0]}."
    else:
        hint = "Is the time in s rather than in a smaller unit? Then add --unit time=s."
    raise DatasetError(
        f"{recording.label}: the median step is {step:.6g} s, {rate:.3g} rows per second, no rate of a robot's log. "
        f"{hint}"
    )


def _first_of_each(time: np.ndarray, begins: np.ndarray, least: float) -> np.ndarray:
    """Rows that come at least `least` after the last one that was kept; the first of an episode always is."""
    kept = np.ones(len(time), bool)
    suspicious = np.flatnonzero(np.diff(time) < least) + 1
    starts = set(begins.tolist())
    last_dropped, reference = -2, 0.0
    for row in suspicious.tolist():
        if row in starts:
            continue
        if row - 1 != last_dropped:
            reference = time[row - 1]
        if time[row] - reference < least:
            kept[row] = False
            last_dropped = row
    return kept
