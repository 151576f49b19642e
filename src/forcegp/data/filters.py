"""What linear filters make of signals: a low-pass, delays and lags, derivatives, other rates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from forcegp.data.configurations import continuous, rates, through
from forcegp.data.dataset import Dataset
from forcegp.errors import DatasetError, InvalidInput
from forcegp.robots.manifold import ConfigurationSpace

Signal = Literal["q", "v", "u", "a"]
Values = Float[np.ndarray, "rows *columns"]
Times = Float[np.ndarray, " rows"]

TRANSIENT = 1e-3  # what is left of a filter's transient at the ends of a recording; sets the length of the padding
HALF = 0.32434  # periods of a cut-off in which the autocorrelation of white noise behind it falls to one half
JITTER = 0.01
"""Largest deviation of a time step from the median step, relative to it, that still counts as uniform sampling."""


@dataclass(frozen=True)
class LowPass:
    """Butterworth low-pass at `cutoff` Hz, run forwards and backwards so that nothing is delayed.

    Both ends are continued by point reflection until the transient has died out, so that straight lines pass; two
    passes square the gain, which is 1/2 at the cut-off. InvalidInput above half the rate, DatasetError for few rows.
    """

    cutoff: float
    order: ClassVar[int] = 4

    def __call__(self, values: Values, time: Times) -> Values:
        """Filtered, for rows at even times. Raises as `uniform_step`."""
        rate = 1.0 / uniform_step(time)
        if not 0 < self.cutoff < rate / 2:
            seen = f"cutoff is {self.cutoff} Hz"
            raise InvalidInput(f"{seen}; it must be > 0 and below {rate / 2:.6g} Hz, half the sample rate.")
        from scipy.signal import butter, sosfiltfilt  # half a second, which only filtering should cost

        sections = butter(self.order, self.cutoff, fs=rate, output="sos")
        slowest = float(np.sqrt(sections[:, 5].max()))  # the product of two conjugate poles is the last coefficient
        with np.errstate(all="ignore"):  # it never dies out at a cut-off of almost 0
            dies = np.ceil(np.log(TRANSIENT) / np.log(slowest)) if slowest < 1.0 else np.inf
        padding = int(max(min(dies, 1e15), self.order + 1))
        if len(values) <= padding:
            which = f"a filter of order {self.order} with a cut-off at {self.cutoff} Hz"
            seen = f"{len(values)} rows are too few for {which}; more than {padding:g} are needed"
            raise DatasetError(f"{seen}. Use a higher cut-off, or leave the episode out.")
        return sosfiltfilt(sections, values, axis=0, padlen=padding)

    def gain(self, frequency: Float[np.ndarray, " k"], rate: float) -> Float[np.ndarray, " k"]:
        """Of amplitudes at these frequencies [Hz], for rows at this rate [Hz]; 0 at half the rate."""
        with np.errstate(over="ignore"):  # infinite at half the sample rate, where nothing passes
            warped = np.tan(np.pi * frequency / rate) / np.tan(np.pi * self.cutoff / rate)
            return 1.0 / (1.0 + np.abs(warped) ** (2 * self.order))

    @property
    def memory(self) -> float:
        """Time [s] within which rows repeat their neighbours, and count as one, where their rate is far higher."""
        return HALF / self.cutoff


def lagged(values: Values, time: Times, seconds: float) -> Values:
    """What an actuator of first order makes of values, at rest with the first of them: T x' + x = values, T in s.

    By Tustin's rule (trapezoids), for equal steps of time. Below zero, what such a filter had made the values of.
    """
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if len(values) < 2 or abs(seconds) <= 0.25 * step:
        return values
    if seconds < 0.0:
        return values - seconds * np.gradient(values, step, axis=0)
    from scipy.signal import lfilter

    ratio = 2.0 * seconds / step
    return np.asarray(lfilter([1.0, 1.0], [1.0 + ratio, 1.0 - ratio], values - values[0], axis=0)) + values[0]


def low_pass(dataset: Dataset, cutoff: float, *, signals: Sequence[Signal] = ("q", "v", "u", "a")) -> Dataset:
    """The Dataset with the named signals behind a `LowPass` within each episode.

    Filtering `a` makes `noise_std` None, filtering q, v or u filters other sensors as well and drops `truth`. Switches
    of contacts stay as they are. Raises as `LowPass`, naming the episode; DatasetError for rows out of order, for
    positions that jump by a turn, and for a base that turns faster than the filter passes.
    """
    if not signals or not set(signals) <= {"q", "v", "u", "a"}:
        raise InvalidInput(f"signals are {tuple(signals)!r}; allowed: one or more of q, v, u, a.")
    smooth = LowPass(cutoff)

    def filtered(name: str, rows: Dataset, label: str) -> np.ndarray:
        if name == "q":
            require_no_turns(rows, label)
            return through(rows.model.robot.space, rows.q, lambda q: smooth(q, rows.time))
        values, forces = getattr(rows, name), len(rows.model.actuators) if name == "u" else rows.nv
        return np.concatenate([smooth(values[:, :forces], rows.time), values[:, forces:]], axis=1)

    def all_of(rows: Dataset, label: str) -> dict[str, np.ndarray]:
        sensors = rows.measured.items() if set(signals) != {"a"} else ()
        return {name: filtered(name, rows, label) for name in signals} | {n: smooth(x, rows.time) for n, x in sensors}

    changed = by_episode(dataset, all_of)
    measured = {name: changed.pop(name, values) for name, values in dataset.measured.items()}
    noise_std = None if "a" in signals else dataset.noise_std
    truth = dataset.truth if set(signals) == {"a"} else {}
    return replace(dataset, **changed, measured=measured, truth=truth, noise_std=noise_std)


def shifted(dataset: Dataset, delay: float, lag: float = 0.0, lagging: Sequence[int] | None = None) -> Dataset:
    """The dataset with the forces of actuators taken `delay` s later, after a `lag` [s] of those columns, or of all."""
    count = len(dataset.model.actuators)
    columns = list(range(count)) if lagging is None else list(lagging)

    def acting(rows: Dataset, label: str) -> dict[str, np.ndarray]:
        u = rows.u.copy()
        u[:, columns] = lagged(u[:, columns], rows.time, lag)
        if delay:  # values at the ends hold beyond them
            u[:, :count] = CubicSpline(rows.time, u[:, :count])(np.clip(rows.time + delay, rows.time[0], rows.time[-1]))
        return {"u": u}

    return replace(dataset, **by_episode(dataset, acting), truth={})


def differentiate(
    values: Float[np.ndarray, "rows columns"], time: Times, space: ConfigurationSpace | None = None
) -> np.ndarray:
    """Central differences, second order also at both ends and for unequal steps (three-point Lagrange formulas).

    Units: those of `values` per second. Positions of a `space` in which they do not add up give velocities (rows, nv)
    in body axes. Raises DatasetError for fewer than three rows or time that does not increase.
    """
    if len(values) < 3:
        raise DatasetError(f"{len(values)} rows are too few to differentiate; at least 3 are needed.")
    if len(time) != len(values) or not (np.diff(time) > 0).all():
        raise DatasetError(f"time must have {len(values)} entries that increase strictly.")
    if space is not None and not space.is_vector_space:
        return rates(space, values, time)
    return np.gradient(values, time, axis=0, edge_order=2)


def uniform_step(time: Times, name: str = "this recording") -> float:
    """The sampling interval [s]. Raises DatasetError if steps differ by more than `JITTER` (1 %) from their median."""
    if len(time) < 2:
        raise DatasetError(f"{name} has {len(time)} row; at least 2 are needed.")
    steps = np.diff(time)
    median = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - median)))
    if median <= 0 or abs(steps[worst] - median) > JITTER * median:
        seen = f"the step after row {worst} is {steps[worst]:.6g} s, the median {median:.6g} s"
        raise DatasetError(f"{name} is not sampled uniformly: {seen}. Resample it first (forcegp.data.resample).")
    return float((time[-1] - time[0]) / (len(time) - 1))


def differentiated(dataset: Dataset, source: Literal["q", "v"] = "v") -> Dataset:
    """The Dataset with `a` computed from `v` by central differences, or `v` and `a` from `q`, within each episode.

    Filter `source` first (`low_pass`). `noise_std` becomes None, and `truth` is dropped where `v` changes. Raises
    DatasetError for rows that are not in order of time, episodes of fewer than 3 rows and jumps; or InvalidInput.
    """
    if source not in ("q", "v"):
        raise InvalidInput(f"source is {source!r}; allowed: 'q' (gives v and a) or 'v' (gives a).")

    def derivatives(rows: Dataset, label: str) -> dict[str, np.ndarray]:
        if source == "v":
            return {"a": differentiate(rows.v, rows.time)}
        require_no_turns(rows, label)
        velocity = differentiate(rows.q, rows.time, rows.model.robot.space)
        return {"v": velocity, "a": differentiate(velocity, rows.time)}

    truth = dataset.truth if source == "v" else {}
    return replace(dataset, **by_episode(dataset, derivatives), truth=truth, noise_std=None)


def resample(dataset: Dataset, step: float) -> Dataset:
    """The Dataset at uniform times, `step` [s] apart, by a cubic spline through each signal of each episode.

    Filter first (`low_pass`) when going to a longer step. Switches of contacts are those of the row before; `truth` and
    `noise_std` are dropped. Raises InvalidInput for a step <= 0 or longer than an episode, DatasetError for rows that
    are not in order of time or positions that jump by a turn.
    """
    if not (np.isfinite(step) and step > 0):
        raise InvalidInput(f"step is {step} s; it must be > 0.")
    parts: list[dict[str, np.ndarray]] = []
    for number, rows, label in episodes_in_order(dataset):
        require_no_turns(rows, label)
        duration = rows.time[-1] - rows.time[0]
        count = int(np.floor(duration / step * (1 + 1e-12))) + 1
        if count < 2:
            raise InvalidInput(f"step is {step} s, longer than {label} ({duration:.6g} s).")
        time = np.minimum(rows.time[0] + step * np.arange(count), rows.time[-1])

        def spline(values: np.ndarray, own: np.ndarray = rows.time, time: np.ndarray = time) -> np.ndarray:
            return CubicSpline(own, values, axis=0)(time)

        signals = {name: spline(getattr(rows, name)) for name in ("v", "u", "a")}
        signals |= {name: spline(values) for name, values in rows.measured.items()}
        signals["q"] = through(rows.model.robot.space, rows.q, spline)
        before = np.searchsorted(rows.time, time * (1 + 1e-12), side="right") - 1
        switches = slice(len(rows.model.actuators), None)
        signals["u"][:, switches] = rows.u[before, switches]
        parts.append({**signals, "time": time, "episode": np.full(count, number)})
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    measured = {name: joined.pop(name) for name in dataset.measured}
    return replace(dataset, **joined, measured=measured, truth={}, noise_std=None, strokes=None)


def episodes_in_order(dataset: Dataset) -> list[tuple[int, Dataset, str]]:
    """Number, rows and name for messages of every episode. Raises DatasetError for rows not in order of time."""
    if not dataset.time_ordered:
        raise DatasetError("the rows are not in order of time (a sample?); filter the whole recording, then sample.")
    return [(number, dataset.select_episodes([number]), f"episode {number}") for number in dataset.episodes]


def sums_before(values: Float[np.ndarray, "rows k"], time: Times, seconds: float) -> Float[np.ndarray, "rows k"]:
    """Sums of the rows before each, with weights exp(-age / seconds); zero for the first."""
    sums, keep = np.zeros_like(values), np.exp(-np.diff(time) / seconds)
    for row in range(1, len(values)):
        sums[row] = keep[row - 1] * (sums[row - 1] + values[row - 1])
    return sums


def by_episode(dataset: Dataset, change: Callable[[Dataset, str], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Apply `change` to each episode and put its rows back where they came from."""
    result: dict[str, np.ndarray] = {}
    for number, rows, label in episodes_in_order(dataset):
        try:
            changed = change(rows, label)
        except DatasetError as error:
            raise error if label in str(error) else DatasetError(f"{label}: {error}") from error
        for name, values in changed.items():
            result.setdefault(name, np.empty_like(values, shape=(len(dataset), *values.shape[1:])))
            result[name][dataset.episode == number] = values
    return result


def require_no_turns(rows: Dataset, label: str) -> None:
    """A position that wraps at pi jumps by a turn; every derivative and filter would take that for motion."""
    space = rows.model.robot.space
    continuous(space, rows.q)
    angular = rows.turns[space.single_rows]
    jumps = np.abs(np.diff(space.singles(torch.from_numpy(rows.q.copy())).numpy()[:, angular], axis=0)) > np.pi
    if jumps.any():
        row, column = np.argwhere(jumps)[0]
        joint = rows.joint_names[np.asarray(space.single_rows)[angular][column]]
        seen = f"{label}: q of joint {joint!r} jumps by more than pi after row {row}; the angle wraps"
        raise DatasetError(f"{seen}. Unwrap it first (np.unwrap(q, axis=0)).")
