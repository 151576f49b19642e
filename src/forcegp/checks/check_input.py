"""What the checks look at: the log as it is, and the same at even times, filtered and differentiated."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from forcegp.data import Dataset, Preparation, Prepared, preparation_report, resample, uniform_step
from forcegp.data.spectrum import FEWEST_ROWS, HIGHEST
from forcegp.errors import DatasetError, InvalidInput
from forcegp.mechanics import MechanicalSystem
from forcegp.robots import Robot

GAP = 5.0
"""Median steps without a row at which a motion is taken for two."""

COMPARED = 0.5
"""Of the cut-off: where torques are compared."""

LONGEST_TRIM = 0.1
"""Most that is trimmed from either end, as a share of the shortest stretch."""

MOST_ROWS = 1000
"""Rows on which torques are compared: neighbouring rows hold the same information."""

FEW_JOINTS = 3
"""Of more joints, half as many rows."""

QUICK_ROWS = 300
"""The same before a fit."""

STRETCHES, STRETCH_ROWS = 3, 500
"""How many stretches of how many rows are looked at before a fit, where a log is longer."""

MOTION = 1.5
"""Ratio of noise as seen by third and by fourth differences above which they see motion instead."""

FEWEST_DIFFERENCES, MOST_DIFFERENCES = 30, 3000
HALF_CUTOFF = COMPARED**2.5
"""Noise of an acceleration that is differenced twice, after a filter at half the cut-off, relative to that before."""

SMOOTH_SECONDS, SMOOTH_ROWS = 0.03, 15
"""Length of the running mean that stands for a filter before a fit: SciPy's filters take half a second to import."""

DEGREE = np.pi / 180.0

JUMP = 10.0
"""A signal that is not measured jumps to 0 by more than so many of the steps that nine of ten rows stay below."""

LEAST_JUMP = 0.02
"""And by more than this share of its range."""

FEWEST_DROPS = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class CheckInput:
    """One log and, if known, its robot.

    `log` is the Dataset as given; `even` its stretches without gaps at even times; `prepared` these after the filter;
    `compared` the same after a filter at half the cut-off: what torques are compared on, so that the noise of the
    acceleration, which is strongest near the cut-off, is not taken for a wrong torque. `automatic`: the
    cut-off is that of the spectrum; `wraps` and `jumps` mark where (rows, nv) a position of `log` jumps by a turn, or
    by more than pi otherwise, `dropped` where a signal is 0 because it was not measured (interpolated in `mended`, a
    log that is otherwise as given). `compared_noise` (nv,) is the standard deviation of the noise of the
    acceleration in `compared`, None where it is not known. `prepared` and `compared` are None where jumps forbid any
    derivative.
    """

    log: Dataset
    robot: Robot | None
    contacts: int
    even: Dataset
    prepared: Prepared | None
    compared: Dataset | None
    automatic: bool
    wraps: Bool[np.ndarray, "rows nv"]
    jumps: Bool[np.ndarray, "rows nv"]
    dropped: Mapping[str, Bool[np.ndarray, "rows nv"]]
    mended: Dataset
    compared_noise: Float[np.ndarray, " nv"] | None
    most_rows: int = MOST_ROWS

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(self.log.joint_names)

    @property
    def rotates(self) -> Bool[np.ndarray, " nv"]:
        """Whether a joint turns; others slide."""
        units = self.log.units["q"]
        return np.array([unit == "rad" for unit in ([units] * self.log.nv if isinstance(units, str) else units)])

    def rows(self) -> Dataset:
        """Up to `most_rows` rows of `compared`, evenly over the log."""
        assert self.compared is not None
        data = self.compared
        most = self.most_rows if data.nv <= FEW_JOINTS else self.most_rows // 2
        return data.rows(slice(None, None, max(1, -(-len(data) // most))))

    @property
    def price(self) -> Mapping[str, Any]:
        """What the filter of the check did, or that of an earlier preparation where this one filters nothing."""
        assert self.prepared is not None
        return self.prepared.report if self.prepared.report["cutoff"] is not None else _earlier(self.log)

    @classmethod
    def of(cls, dataset: Dataset, system: MechanicalSystem | None, preparation: Preparation) -> CheckInput:
        """Prepare a log for the checks. Raises InvalidInput for one that is too short, or whose rows lack an order."""
        if not dataset.time_ordered:
            raise InvalidInput("the rows are not in order of time (a sample of rows?); check the whole recording.")
        system = dataset.system if system is None else system
        dropped = {name: drop_outs(dataset, name) for name in ("q", "v", "u", "a")}
        mended = _mended(dataset, dropped)
        wraps, jumps = _leaps(mended)
        even = _even(_unwrapped(mended, wraps), jumps)
        prepared = compared = None
        if not jumps.any():
            shortest = min(np.ptp(even.time[even.episode == number]) for number in even.episodes)
            chosen = replace(preparation, every=1, delay=0.0).resolved(even)
            trim = 0.0 if chosen.cutoff is None else min(1.0 / float(chosen.cutoff), LONGEST_TRIM * shortest)
            prepared = replace(chosen, trim=float(trim)).apply(even)
            compared = prepared.dataset
            applied = chosen.cutoff or _earlier(dataset).get("cutoff")
            if applied is not None and COMPARED * float(applied) < HIGHEST * 0.5 / uniform_step(_first(even)):
                lower = COMPARED * float(applied)
                compared = replace(chosen, cutoff=lower, trim=min(1.0 / lower, LONGEST_TRIM * shortest)).rows(even)
        return cls(
            log=dataset,
            robot=None if system is None else system.robot,
            contacts=0 if system is None else len(system.contacts),
            even=even,
            prepared=prepared,
            compared=compared,
            automatic=preparation.cutoff == "auto",
            wraps=wraps,
            jumps=jumps,
            dropped=dropped,
            mended=mended,
            compared_noise=None if compared is None else np.nan_to_num(_filtered_noise(mended, prepared, compared)),
        )

    @classmethod
    def quick(cls, dataset: Dataset, system: MechanicalSystem | None) -> CheckInput:
        """The same without filters and from few rows, for a look before a fit; also for short and unordered logs."""
        system = dataset.system if system is None else system
        dropped, mended = {}, dataset
        even, prepared = dataset, None
        wraps = jumps = np.zeros(dataset.q.shape, dtype=bool)
        compared: Dataset | None = dataset
        noise = dataset.noise_level
        if dataset.time_ordered:
            dropped = {name: drop_outs(dataset, name) for name in ("q", "v", "u", "a")}
            mended = _mended(dataset, dropped)
            wraps, jumps = _leaps(mended)
            compared = None if jumps.any() else _smoothed(_unwrapped(mended, wraps))
            with contextlib.suppress(InvalidInput):
                even = _even(_few(mended if compared is None else compared), jumps)
                prepared = None if compared is None else Preparation().apply(even)
            seen = None if compared is None else white_noise(mended, _width(mended))
            noise = noise if seen is None else np.nan_to_num(seen)
        return cls(
            log=dataset,
            robot=None if system is None else system.robot,
            contacts=0 if system is None else len(system.contacts),
            even=even,
            prepared=prepared,
            compared=compared,
            automatic=False,
            wraps=wraps,
            jumps=jumps,
            dropped=dropped,
            mended=mended,
            compared_noise=noise,
            most_rows=QUICK_ROWS,
        )


def _earlier(dataset: Dataset) -> Mapping[str, Any]:
    """The report of a preparation with a filter that this dataset went through; empty without one."""
    report = preparation_report(dataset.metadata)
    while report and report.get("cutoff") is None:
        report = preparation_report({"preparation": report.get("earlier")})
    return report


def _first(even: Dataset) -> np.ndarray:
    return even.time[even.episode == even.episode[0]]


def consecutive(dataset: Dataset) -> Bool[np.ndarray, " rows"]:
    """Whether the next row belongs to the same episode and follows; False for the last row."""
    return np.append(dataset.episode[1:] == dataset.episode[:-1], False)


def drop_outs(dataset: Dataset, name: str) -> Bool[np.ndarray, "rows nv"]:
    """Where a signal is exactly 0 between values far from 0: it was not measured, or lost on its way."""
    values = getattr(dataset, name)
    lost = np.zeros(values.shape, dtype=bool)
    follows = consecutive(dataset)[:-1]
    for joint in np.flatnonzero(((values == 0.0).sum(axis=0) >= FEWEST_DROPS) & (np.ptp(values, axis=0) > 0.0)):
        x = values[:, joint]
        steps = np.abs(np.diff(x))
        usual = max(
            JUMP * float(np.quantile(steps, 0.9)), LEAST_JUMP * float(np.ptp(x)), 1e-9 * float(np.abs(values).max())
        )
        edges = np.flatnonzero(np.diff(np.concatenate([[False], x == 0.0, [False]]).astype(int)))
        runs = edges.reshape(-1, 2)
        into, out = runs[:, 0] - 1, runs[:, 1] - 1  # the steps that lead into a run of zeros, and out of it
        inner = (into >= 0) & (out < len(steps))
        runs, into, out = runs[inner], into[inner], out[inner]
        sudden = (steps[into] > usual) & (steps[out] > usual) & follows[into] & follows[out]
        for start, stop in runs[sudden] if sudden.sum() >= FEWEST_DROPS else []:
            lost[start:stop, joint] = True
    return lost


def _mended(dataset: Dataset, dropped: Mapping[str, np.ndarray]) -> Dataset:
    """With straight lines where signals dropped out, so that nothing else is blamed for it."""
    changed = {}
    for name, lost in dropped.items():
        if lost.any():
            values = getattr(dataset, name).copy()
            for joint in np.flatnonzero(lost.any(axis=0)):
                gone = lost[:, joint]
                values[gone, joint] = np.interp(np.flatnonzero(gone), np.flatnonzero(~gone), values[~gone, joint])
            changed[name] = values
    return replace(dataset, **changed, truth={}) if changed else dataset


def _leaps(dataset: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Jumps of an angle by a turn, and by more than pi otherwise, after each row."""
    change = np.zeros_like(dataset.q)
    change[:-1] = np.diff(dataset.q, axis=0)
    change[~consecutive(dataset)] = 0.0
    units = dataset.units["q"]
    angular = np.array([unit == "rad" for unit in ([units] * dataset.nv if isinstance(units, str) else units)])
    size = np.abs(change)
    turn = (np.abs(size - 2.0 * np.pi) < 0.5) & angular
    return turn, (size > np.pi) & angular & ~turn


def _few(dataset: Dataset) -> Dataset:
    """A few stretches of successive rows, evenly over the log, each an episode."""
    if len(dataset) <= STRETCHES * STRETCH_ROWS:
        return dataset
    starts = np.linspace(0, len(dataset) - STRETCH_ROWS, STRETCHES).astype(int)
    rows = (starts[:, None] + np.arange(STRETCH_ROWS)).ravel()
    pieces = np.repeat(np.arange(STRETCHES), STRETCH_ROWS)
    _, numbers = np.unique(np.stack([pieces, dataset.episode[rows]]), axis=1, return_inverse=True)
    return replace(dataset.rows(rows), episode=numbers.ravel())


def _width(dataset: Dataset) -> int:
    """Rows of the running mean."""
    steps = np.diff(dataset.time)[consecutive(dataset)[:-1]]
    width = int(min(SMOOTH_SECONDS / np.median(steps), SMOOTH_ROWS)) // 2 * 2 + 1 if len(steps) else 1
    return width if len(dataset) >= 10 * width else 1


def _smoothed(dataset: Dataset) -> Dataset:
    """Running means of all signals within each episode, of one length for all: the equation of motion keeps holding."""
    width = _width(dataset)
    inside = _whole_windows(dataset, width)
    if width < 3 or not len(inside):
        return dataset
    means = {name: _means(getattr(dataset, name), inside, width) for name in ("q", "v", "u", "a")}
    rows = dataset.rows(inside + width // 2)
    return replace(rows, **means, noise_std=None, truth={})


def _whole_windows(dataset: Dataset, width: int) -> np.ndarray:
    """First rows of the windows of so many rows that lie within an episode."""
    breaks = np.cumsum(np.insert(~consecutive(dataset), 0, False))
    first = np.arange(max(0, len(dataset) - width + 1))
    return first[breaks[first + width - 1] == breaks[first]]


def _means(values: np.ndarray, first: np.ndarray, width: int) -> np.ndarray:
    sums = np.cumsum(np.insert(values, 0, 0.0, axis=0), axis=0)
    return (sums[first + width] - sums[first]) / width


def white_noise(log: Dataset, width: int = 1) -> Float[np.ndarray, " nv"] | None:
    """Standard deviation of noise on `a`, or on its means over `width` rows, from differences of successive ones.

    The k-th difference of white noise has the variance binomial(2k, k), that of a smooth motion falls with k: NaN where
    it is motion that is seen. Medians, since impacts are no noise. None for rows out of order and fewer than 30.
    """
    if not log.time_ordered:
        return None
    noise = []
    for order, variance in ((3, 20.0), (4, 70.0)):
        first = _whole_windows(log, width * (order + 1))
        if len(first) < FEWEST_DIFFERENCES:
            return None
        first = first[:: max(1, len(first) // MOST_DIFFERENCES)]
        means = np.stack([_means(log.a, first + k * width, width) for k in range(order + 1)])
        differences = np.diff(means, order, axis=0)[0]
        noise.append(1.4826 * np.median(np.abs(differences), axis=0) / np.sqrt(variance))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where((noise[0] < MOTION * noise[1]) & (noise[1] > 0.0), noise[1], np.nan)


def _filtered_noise(log: Dataset, prepared: Prepared | None, compared: Dataset) -> np.ndarray:
    """Noise of the acceleration in `compared`: white noise as logged, or what the filter left."""
    price = {} if prepared is None else prepared.report.get("acceleration_noise", {})
    if "after" in price:
        return np.array([np.nan if value is None else value for value in price["after"]], dtype=float) * HALF_CUTOFF
    seen = white_noise(log)
    return np.zeros(compared.nv) if seen is None else seen


def _unwrapped(dataset: Dataset, wraps: np.ndarray) -> Dataset:
    if not wraps.any():
        return dataset
    q = dataset.q.copy()
    for number in dataset.episodes:
        own = dataset.episode == number
        q[own] = np.unwrap(q[own], axis=0)
    return replace(dataset, q=q, truth={})


def _even(dataset: Dataset, jumps: np.ndarray) -> Dataset:
    """Stretches without gaps, each an episode, at even times."""
    pieces: list[np.ndarray] = []
    for number in dataset.episodes:
        rows = np.flatnonzero(dataset.episode == number)
        steps = np.diff(dataset.time[rows])
        breaks = np.flatnonzero(steps > GAP * np.median(steps)) + 1 if len(steps) else []
        pieces += [piece for piece in np.split(rows, breaks) if len(piece) >= FEWEST_ROWS]
    if not pieces:
        raise InvalidInput(
            f"no stretch of {FEWEST_ROWS} rows without a gap; a check needs one. Give a longer recording, or number "
            "the episodes."
        )
    rows = np.concatenate(pieces)
    numbers = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    even = replace(dataset.rows(rows), episode=numbers, noise_std=None, truth={}, time_ordered=True)
    try:
        steps = [uniform_step(even.time[even.episode == number]) for number in even.episodes]
        if max(steps) - min(steps) <= 1e-3 * max(steps):
            return even
    except DatasetError:
        pass
    if jumps.any():
        return even  # a spline through a jump would be of no use, and nothing is differentiated then
    return resample(even, float(np.median(np.concatenate([np.diff(dataset.time[piece]) for piece in pieces]))))
