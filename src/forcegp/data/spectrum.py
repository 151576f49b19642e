"""Where motion ends and noise begins: power spectra of a log, its noise floor, and the cut-off that follows from them.

Spectra are Welch's (1967, "The use of fast Fourier transform for the estimation of power spectra"), over segments of
all episodes. Positions are differenced first and the spectrum divided by the gain of the differences, so that the
slow, strong motion does not leak into the band of the noise (prewhitening; Percival & Walden 1993, section 6.5).

Why the knee of the differentiated spectrum, the floor above it and the cut-off belong together:
docs/how-to/checking.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from forcegp.data.configurations import as_vectors
from forcegp.data.dataset import Dataset
from forcegp.data.filtering import episodes_in_order, uniform_step
from forcegp.errors import DatasetError

SEGMENT = 4.0  # s
FEWEST_ROWS = 64
BANDS_PER_OCTAVE = 6
FLOOR_BAND = (1.2, 5.0)
"""Where the floor is read, in multiples of the knee."""

CUTOFF_BAND = 3.0
"""The cut-off is at most so many times the knee."""

HIGHEST = 0.8
"""Of half the sample rate: above it a filter is not worth its name."""

MOTION_SHARE = 0.99
"""Of the power of the signal: the knee is sought above the frequency below which so much of it lies."""

LEAST_RISE = 10.0
"""Noise that deserves a filter rises above the knee, in the differentiated signal, by this factor at least."""

LEAST_NOISE = 1e-3
"""Noise of the unfiltered acceleration, relative to its spread, below which there is nothing to filter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionSpectrum:
    """Spectrum and noise floor of the signal that is differentiated, per joint.

    `density` (frequencies, nv) is the one-sided power density of `source` [unit^2/Hz] at `frequency` [Hz]; `knee` (nv,)
    [Hz], `floor` (nv,) [unit^2/Hz] and `cutoff` (nv,) [Hz] are NaN for a joint whose spectrum shows no noise floor:
    it does not move, was filtered already, or has hardly any noise.
    """

    source: Literal["q", "v"]
    step: float
    frequency: Float[np.ndarray, " frequencies"]
    density: Float[np.ndarray, "frequencies nv"]
    knee: Float[np.ndarray, " nv"]
    floor: Float[np.ndarray, " nv"]
    cutoff: Float[np.ndarray, " nv"]

    @property
    def acceleration_density(self) -> Float[np.ndarray, "frequencies nv"]:
        """Power density of the acceleration by exact derivatives [unit^2/s^4/Hz]."""
        return self.density * (2.0 * np.pi * self.frequency[:, None]) ** (2 * _derivatives(self.source))

    @property
    def noise_density(self) -> Float[np.ndarray, "frequencies nv"]:
        """Power density of the noise of `source`: the floor below the knee, what was seen above it; NaN if unknown."""
        below = self.frequency[:, None] < self.knee
        noise = np.where(below, np.minimum(self.density, self.floor), self.density)
        return np.where(np.isfinite(self.floor), noise, np.nan)

    def acceleration_noise(self, gain: Callable[[np.ndarray], np.ndarray] | None = None) -> Float[np.ndarray, " nv"]:
        """Standard deviation of the noise that central differences make of `source` [rad/s^2 or m/s^2]; NaN if unknown.

        `gain` is that of the filter before them, at frequencies in Hz. Central differences have the gain
        `sin(2 pi f h) / h` per derivative.
        """
        response = (np.sin(2.0 * np.pi * self.frequency * self.step) / self.step) ** (2 * _derivatives(self.source))
        if gain is not None:
            response = response * gain(self.frequency) ** 2
        return np.sqrt((self.noise_density * response[:, None]).sum(axis=0) * (self.frequency[1] - self.frequency[0]))


def motion_spectrum(dataset: Dataset, source: Literal["q", "v"] = "q") -> MotionSpectrum:
    """The spectrum of `source` over all episodes, with knee, floor and cut-off of every joint.

    Raises DatasetError for fewer than 64 rows in the longest episode, rows out of order or sampled unevenly.
    """
    values = as_vectors(dataset) if source == "q" else dataset.v
    frequency, density, segments, step = power_density(dataset, values, _derivatives(source))
    found = [_knee_and_floor(frequency, column, segments, _derivatives(source)) for column in density.T]
    knee, floor, cutoff = (np.array(values) for values in zip(*found, strict=True))
    spectrum = MotionSpectrum(
        source=source, step=step, frequency=frequency, density=density, knee=knee, floor=floor, cutoff=cutoff
    )
    motion = np.sqrt((spectrum.acceleration_density * (frequency[:, None] <= knee)).sum(axis=0) * frequency[0])
    with np.errstate(invalid="ignore"):
        quiet = spectrum.acceleration_noise() < LEAST_NOISE * motion
    spectrum.cutoff[quiet] = np.nan  # the floor is that of the rounding of numbers
    return spectrum


def power_density(
    dataset: Dataset, values: Float[np.ndarray, "rows nv"], differences: int = 0
) -> tuple[Float[np.ndarray, " frequencies"], Float[np.ndarray, "frequencies nv"], float, float]:
    """Frequencies > 0 [Hz], one-sided power density of `values` [unit^2/Hz], number of segments that count, time step.

    Hann windows of up to 4 s with half of them in common (9/11 of the segments count then; Welch 1967). Episodes
    shorter than a window are left out. `differences` is how often the values are differenced before.
    """
    from scipy.signal import welch

    episodes = episodes_in_order(dataset)
    steps = [uniform_step(rows.time, label) for _, rows, label in episodes if len(rows) > 1]
    longest = max(len(rows) for _, rows, _ in episodes)
    if longest < FEWEST_ROWS:
        raise DatasetError(
            f"the longest episode has {longest} rows; a spectrum needs {FEWEST_ROWS}. Give the cut-off in Hz."
        )
    step = float(np.median(steps))
    window = min(max(FEWEST_ROWS // 2, round(SEGMENT / step)), longest - differences)
    frequency, total, weight, segments = np.zeros(0), np.zeros((0, 0)), 0, 0.0
    for number, rows, _ in episodes:
        if len(rows) - differences < window:
            continue
        change = np.diff(values[dataset.episode == number], n=differences, axis=0) / step**differences
        frequency, density = welch(change, 1.0 / step, nperseg=window, axis=0)
        total = density * len(rows) + (total if weight else 0.0)
        weight += len(rows)
        segments += 1.0 + max(0.0, len(change) / (window / 2.0) - 2.0) * 9.0 / 11.0
    response = (2.0 * np.sin(np.pi * frequency[1:] * step) / step) ** (2 * differences)
    return frequency[1:], (total / weight)[1:] / response[:, None], segments, step


def _derivatives(source: str) -> int:
    """Derivatives that lead from the signal to the acceleration."""
    return 2 if source == "q" else 1


def _knee_and_floor(
    frequency: Float[np.ndarray, " frequencies"],
    density: Float[np.ndarray, " frequencies"],
    segments: float,
    derivatives: int,
) -> tuple[float, float, float]:
    """Knee [Hz], floor [unit^2/Hz] and cut-off [Hz] of one joint; NaN where there are none."""
    nothing = (np.nan, np.nan, np.nan)
    power = np.cumsum(density)
    if not power[-1] > 0.0:
        return nothing
    centers, smooth = _bands(frequency, density)
    envelope = np.maximum.accumulate(smooth[::-1])[::-1]  # a gap between two harmonics is no end of the motion
    start = frequency[np.searchsorted(power, MOTION_SHARE * power[-1])]
    allowed = (centers >= start) & (centers <= HIGHEST * frequency[-1])
    if not allowed.any():
        return nothing
    differentiated = envelope * centers ** (2 * derivatives)
    lowest = int(np.flatnonzero(allowed)[np.argmin(differentiated[allowed])])
    if differentiated[lowest:].max() < LEAST_RISE * differentiated[lowest]:
        return nothing
    knee = centers[lowest]
    band = (frequency >= FLOOR_BAND[0] * knee) & (frequency <= min(FLOOR_BAND[1] * knee, 0.95 * frequency[-1]))
    if not band.any():
        return nothing
    floor = float(np.median(density[band])) / (1.0 - 1.0 / (9.0 * segments)) ** 3  # Wilson & Hilferty: median of chi^2
    near = centers <= CUTOFF_BAND * knee  # noise need not be flat: only what is next to the motion counts
    above = np.flatnonzero(smooth[near] > 2.0 * floor)
    if not len(above) or above[-1] + 1 >= near.sum():
        return nothing
    left, right = above[-1], above[-1] + 1
    share = np.log(smooth[left] / (2.0 * floor)) / np.log(smooth[left] / smooth[right])
    cutoff = float(np.exp(np.log(centers[left]) * (1.0 - share) + np.log(centers[right]) * share))
    return float(knee), floor, cutoff if cutoff <= HIGHEST * frequency[-1] else np.nan


def _bands(frequency: np.ndarray, density: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres and mean densities of bands of a sixth of an octave, or of single frequencies where those are wider."""
    number = np.unique(np.round(BANDS_PER_OCTAVE * np.log2(frequency / frequency[0])), return_inverse=True)[1]
    count = np.bincount(number)
    return np.exp(np.bincount(number, np.log(frequency)) / count), np.bincount(number, density) / count
