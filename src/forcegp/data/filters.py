"""`Filter`: what a linear filter makes of signals, its gain, and for how long the noise behind it remembers itself."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Complex, Float
from scipy.interpolate import CubicSpline

from forcegp.data.configurations import actuators, space_of, through
from forcegp.data.dataset import Dataset
from forcegp.data.sampling import by_episode, require_no_turns, uniform_step
from forcegp.errors import DatasetError, InvalidInput
from forcegp.robots.arguments import whole_number

Signal = Literal["q", "v", "u", "a"]
Values = Float[np.ndarray, "rows columns"]

TRANSIENT = 1e-3  # What is left of a filter's transient at the ends of a recording; sets the length of the padding
PASSED = 3.0  # Rows in a period of a cut-off, of which more repeat their neighbours


class Filter(ABC):
    """A linear filter of signals in time; `(a >> b)(values, time)` is b behind a."""

    @abstractmethod
    def __call__(self, values: Values, time: Float[np.ndarray, " rows"]) -> Values:
        """The values behind the filter, at the same times [s]."""

    @abstractmethod
    def gain(self, frequency: Float[np.ndarray, " k"], rate: float) -> Complex[np.ndarray, " k"]:
        """Of amplitudes at these frequencies [Hz], for rows at this rate [Hz]."""

    @property
    def memory(self) -> float:
        """Time [s] within which noise behind the filter repeats itself: rows closer than that count as one."""
        return 0.0

    def __rshift__(self, other: Filter) -> Filter:
        return Chain((self, other))


@dataclass(frozen=True)
class Chain(Filter):
    """Filters one after the other."""

    parts: tuple[Filter, ...]

    def __call__(self, values: Values, time: Float[np.ndarray, " rows"]) -> Values:
        """Through all of them."""
        for part in self.parts:
            values = part(values, time)
        return values

    def gain(self, frequency: Float[np.ndarray, " k"], rate: float) -> Complex[np.ndarray, " k"]:
        """The product."""
        return np.prod([part.gain(frequency, rate) for part in self.parts], axis=0)

    @property
    def memory(self) -> float:
        """That of the slowest."""
        return max(part.memory for part in self.parts)


@dataclass(frozen=True)
class LowPass(Filter):
    """Butterworth low-pass at `cutoff` Hz, run forwards and backwards so that nothing is delayed.

    Both ends are continued by point reflection until the filter's transient has died out, so that straight lines pass.
    Two passes square the gain: `1 / (1 + (tan(pi f / f_s) / tan(pi f_c / f_s))^(2 order))`, so 1/2 at the cut-off.
    Raises InvalidInput for a cut-off at or above half the sample rate, DatasetError for too few rows.
    """

    cutoff: float
    order: int = 4

    def __call__(self, values: Values, time: Float[np.ndarray, " rows"]) -> Values:
        """Filtered, for rows at even times. Raises as `uniform_step`."""
        rate = 1.0 / uniform_step(time)
        if not 0 < self.cutoff < rate / 2:
            raise InvalidInput(
                f"cutoff is {self.cutoff} Hz; it must be > 0 and below {rate / 2:.6g} Hz, half the sample rate."
            )
        whole_number("order", self.order, 1, 12)
        from scipy.signal import butter, sosfiltfilt  # half a second, which only filtering should cost

        sections = butter(self.order, self.cutoff, fs=rate, output="sos")
        slowest = np.abs(butter(self.order, self.cutoff, fs=rate, output="zpk")[1]).max()
        padding = max(int(np.ceil(np.log(TRANSIENT) / np.log(slowest))), self.order + 1)
        if len(values) <= padding:
            raise DatasetError(
                f"{len(values)} rows are too few for a filter of order {self.order} with a cut-off at {self.cutoff} Hz;"
                f" more than {padding} are needed. Use a higher cut-off, or leave the episode out."
            )
        return sosfiltfilt(sections, values, axis=0, padlen=padding)

    def gain(self, frequency: Float[np.ndarray, " k"], rate: float) -> Complex[np.ndarray, " k"]:
        """Real, and 0 at half the rate."""
        with np.errstate(over="ignore"):  # infinite at half the sample rate, where nothing passes
            warped = np.tan(np.pi * frequency / rate) / np.tan(np.pi * self.cutoff / rate)
            return 1.0 / (1.0 + np.abs(warped) ** (2 * self.order)) + 0j

    @property
    def memory(self) -> float:
        """A third of the period of the cut-off."""
        return 1.0 / (PASSED * self.cutoff)


@dataclass(frozen=True)
class Later(Filter):
    """The values so many seconds later, by a cubic spline; those at the ends hold beyond them."""

    seconds: float

    def __call__(self, values: Values, time: Float[np.ndarray, " rows"]) -> Values:
        """At `time + seconds`."""
        if self.seconds == 0.0:
            return values
        return CubicSpline(time, values)(np.clip(time + self.seconds, time[0], time[-1]))

    def gain(self, frequency: Float[np.ndarray, " k"], rate: float) -> Complex[np.ndarray, " k"]:
        """Of size 1."""
        return np.exp(2j * np.pi * frequency * self.seconds)


@dataclass(frozen=True)
class Lag(Filter):
    """What an actuator of first order with that time constant makes of values, at rest with the first of them.

    By Tustin's rule (trapezoids), exact for values that are linear between equal steps of time up to the square of
    step over time constant.
    """

    seconds: float

    def __call__(self, values: Values, time: Float[np.ndarray, " rows"]) -> Values:
        """T x' + x = values."""
        step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        if self.seconds <= 0.25 * step:
            return values
        from scipy.signal import lfilter

        ratio = 2.0 * self.seconds / step
        return np.asarray(lfilter([1.0, 1.0], [1.0 + ratio, 1.0 - ratio], values - values[0], axis=0)) + values[0]

    def gain(self, frequency: Float[np.ndarray, " k"], rate: float) -> Complex[np.ndarray, " k"]:
        """Of the differential equation."""
        return 1.0 / (1.0 + 2j * np.pi * frequency * self.seconds)


@dataclass(frozen=True)
class Mean(Filter):
    """Means over windows of `rows` rows about each, an odd number; windows are shorter at the ends."""

    rows: int

    def __call__(self, values: Values, time: Float[np.ndarray, " rows"] | None = None) -> Values:
        """Averaged."""
        total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
        place = np.arange(len(values))
        first = np.maximum(place - self.rows // 2, 0)
        last = np.minimum(place + self.rows // 2 + 1, len(values))
        return (total[last] - total[first]) / (last - first)[:, None]

    def gain(self, frequency: Float[np.ndarray, " k"], rate: float) -> Complex[np.ndarray, " k"]:
        """Dirichlet's kernel."""
        angles = 2.0 * np.pi * frequency / rate
        return sum(np.cos(k * angles) for k in range(-(self.rows // 2), self.rows // 2 + 1)) / self.rows + 0j


def low_pass(dataset: Dataset, cutoff: float, *, signals: Sequence[Signal] = ("q", "v", "u", "a")) -> Dataset:
    """The Dataset with the named signals behind a `LowPass` within each episode.

    Filtering `a` changes its noise, whose standard deviation is then no longer known (`noise_std` None). Filtering q,
    v or u drops `truth`: with it, the equation of motion would no longer hold in the changed rows. Switches of contacts
    stay as they are. Raises as `LowPass`, naming the episode; DatasetError for rows that are not in order of time, for
    positions that jump by a turn, and for a base that turns faster than the filter passes.
    """
    if not signals or not set(signals) <= {"q", "v", "u", "a"}:
        raise InvalidInput(f"signals are {tuple(signals)!r}; allowed: one or more of q, v, u, a.")
    smooth = LowPass(cutoff)

    def filtered(name: str, rows: Dataset, label: str) -> np.ndarray:
        if name == "q":
            require_no_turns(rows, label)
            return through(space_of(rows), rows.q, lambda q: smooth(q, rows.time))
        values = getattr(rows, name)
        forces = actuators(rows) if name == "u" else rows.nv
        return np.concatenate([smooth(values[:, :forces], rows.time), values[:, forces:]], axis=1)

    changed = by_episode(dataset, lambda rows, label: {name: filtered(name, rows, label) for name in signals})
    noise_std = None if "a" in signals else dataset.noise_std
    return replace(dataset, **changed, truth=dataset.truth if set(signals) == {"a"} else {}, noise_std=noise_std)


def shifted(dataset: Dataset, seconds: Sequence[float] | np.ndarray, lags: Sequence[float] = ()) -> Dataset:
    """The dataset with each actuator's force taken so many seconds later, after a lag [s] where one is given."""
    ways = [Lag(lag) >> Later(each) for each, lag in zip(seconds, lags or [0.0] * len(seconds), strict=True)]

    def acting(rows: Dataset, label: str) -> dict[str, np.ndarray]:
        moved = [way(rows.u[:, joint], rows.time) for joint, way in enumerate(ways)]
        return {"u": np.column_stack([*moved, rows.u[:, len(moved) :]])}

    return replace(dataset, **by_episode(dataset, acting), truth={})
