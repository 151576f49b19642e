"""Where motion ends and noise begins: spectra (Welch 1967), noise floor and cut-off; see docs/how-to/checking.md."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from forcegp.data.configurations import as_vectors
from forcegp.data.dataset import Dataset
from forcegp.data.delay import ROWS_PER_PARAMETER, estimate_delay, torque_columns
from forcegp.data.filters import LowPass, Signal, differentiated, episodes_in_order, low_pass, shifted, uniform_step
from forcegp.data.strokes import joint_positions, strokes, with_strokes
from forcegp.data.views import stays
from forcegp.errors import DatasetError

DERIVATIVES = {"q": 2, "v": 1}  # that lead from a signal to the acceleration
SEGMENT = 4.0  # s
FEWEST_ROWS = 64
BANDS_PER_OCTAVE = 6
FLOOR_BAND = (1.2, 5.0)  # where the floor is read, in multiples of the knee
CUTOFF_BAND = 3.0  # the cut-off is at most so many times the knee
HIGHEST = 0.8  # of half the sample rate: above it a filter is not worth its name
MOTION_SHARE = 0.99  # of the power of the signal: the knee is sought above the frequency below which so much of it lies
LEAST_RISE = 10.0
"""Noise that deserves a filter rises above the knee, in the differentiated signal, by this factor at least."""

LEAST_NOISE = 1e-3
"""Noise of the unfiltered acceleration, relative to its spread, below which there is nothing to filter."""
RESTING = 0.02  # share of rows in which a joint rests, from which on a filter would let it creep too often
FACTORS = 0.5, 0.7, 1.0, 1.4, 2.0  # of the cut-off that the spectrum shows
MOST_ROWS, MOST_NUMBERS = 20_000, 2.5e7
FOLDS = 8  # stretches of time: the odd ones judge what the even ones teach, and the other way round
SETTLED = 2.0  # periods of the lowest cut-off at the ends of an episode that filters spoil
Source = Literal["q", "v"]
Frequencies = Float[np.ndarray, " frequencies"]


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionSpectrum:
    """Spectrum and noise floor of the signal that is differentiated, per joint.

    `density` (frequencies, nv) is the one-sided power density of `source` [unit^2/Hz] at `frequency` [Hz]; `knee` (nv,)
    [Hz], `floor` (nv,) [unit^2/Hz] and `cutoff` (nv,) [Hz] are NaN for a joint whose spectrum shows no noise floor:
    it does not move, was filtered already, or has hardly any noise.
    """

    source: Source
    step: float
    frequency: Frequencies
    density: Float[np.ndarray, "frequencies nv"]
    knee: Float[np.ndarray, " nv"]
    floor: Float[np.ndarray, " nv"]
    cutoff: Float[np.ndarray, " nv"]

    @property
    def noise_density(self) -> Float[np.ndarray, "frequencies nv"]:
        """Power density of the noise of `source`: the floor below the knee, what was seen above it; NaN if unknown."""
        below = self.frequency[:, None] <= self.knee * (1.0 + 1e-9)  # a band of one frequency has its knee there
        noise = np.where(below, np.minimum(self.density, self.floor), self.density)
        return np.where(np.isfinite(self.floor), noise, np.nan)

    def acceleration_noise(self, behind: LowPass | None = None) -> Float[np.ndarray, " nv"]:
        """Standard deviation of the noise that central differences make of `source` [rad/s^2 or m/s^2]; NaN if unknown.

        `behind` is the filter before them. Central differences have the gain `sin(2 pi f h) / h` per derivative.
        """
        response = (np.sin(2.0 * np.pi * self.frequency * self.step) / self.step) ** (2 * DERIVATIVES[self.source])
        if behind is not None:
            response = response * behind.gain(self.frequency, 1.0 / self.step) ** 2
        return np.sqrt((self.noise_density * response[:, None]).sum(axis=0) * (self.frequency[1] - self.frequency[0]))


def motion_spectrum(dataset: Dataset, source: Source = "q") -> MotionSpectrum:
    """The spectrum of `source` over all episodes, with knee, floor and cut-off of every joint.

    Raises DatasetError for fewer than 64 rows in the longest episode, rows out of order or sampled unevenly.
    """
    values = as_vectors(dataset) if source == "q" else dataset.v
    frequency, density, segments, step = power_density(dataset, values, DERIVATIVES[source])
    found = [_knee_and_floor(frequency, column, segments, DERIVATIVES[source]) for column in density.T]
    knee, floor, cutoff = (np.array(values) for values in zip(*found, strict=True))
    spectrum = MotionSpectrum(
        source=source, step=step, frequency=frequency, density=density, knee=knee, floor=floor, cutoff=cutoff
    )
    acceleration = density * (2.0 * np.pi * frequency[:, None]) ** (2 * DERIVATIVES[source])
    motion = np.sqrt((acceleration * (frequency[:, None] <= knee)).sum(axis=0) * frequency[0])
    with np.errstate(invalid="ignore"):
        quiet = spectrum.acceleration_noise() < LEAST_NOISE * motion
    spectrum.cutoff[quiet] = np.nan  # the floor is that of the rounding of numbers
    return spectrum


def power_density(
    dataset: Dataset, values: Float[np.ndarray, "rows nv"], differences: int = 0
) -> tuple[Frequencies, Float[np.ndarray, "frequencies nv"], float, float]:
    """Frequencies > 0 [Hz], one-sided power density of `values` [unit^2/Hz], number of segments that count, time step.

    Hann windows of up to 4 s (Welch 1967); shorter episodes are left out. Values are differenced so often before.
    """
    from scipy.signal import welch

    episodes = episodes_in_order(dataset)
    steps = [uniform_step(rows.time, label) for _, rows, label in episodes if len(rows) > 1]
    longest = max(len(rows) for _, rows, _ in episodes)
    if longest < FEWEST_ROWS:
        seen = f"the longest episode has {longest} rows; a spectrum needs {FEWEST_ROWS}"
        raise DatasetError(f"{seen}. Give the cut-off in Hz.")
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


def _knee_and_floor(
    frequency: Frequencies, density: Frequencies, segments: float, derivatives: int
) -> tuple[float, float, float]:
    """Knee [Hz], floor [unit^2/Hz] and cut-off [Hz] of one joint; NaN where there are none."""
    nothing, power = (np.nan, np.nan, np.nan), np.cumsum(density)
    if not power[-1] > 0.0:
        return nothing
    # of bands of a sixth of an octave, or of single frequencies where those are wider
    band = np.unique(np.round(BANDS_PER_OCTAVE * np.log2(frequency / frequency[0])), return_inverse=True)[1]
    centers, smooth = (np.bincount(band, x) / np.bincount(band) for x in (np.log(frequency), density))
    centers = np.exp(centers)
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


def held_out_cutoff(dataset: Dataset, cutoff: float, source: Source = "q") -> tuple[float, dict[float, float]]:
    """The best of `FACTORS` times `cutoff` [Hz], and of each the share of the torques that it leaves unexplained.

    A low cut-off smears dry friction, a high one leaves noise. So a linear model is learned behind each, and all are
    judged alike: signals behind the highest, torques behind the lowest (parallel filtering; Gautier, ICRA 1997), in
    time that was held out. Raises DatasetError for logs too short for that, and for passive robots.
    """
    best, shares = _judged(dataset, cutoff, source)
    if best in (min(shares), max(shares)):  # the best may lie beyond
        best, more = _judged(dataset, best, source)
        shares = shares | more
    return best, dict(sorted(shares.items()))


def with_strokes_of_rests(filtered: Dataset, raw: Dataset) -> Dataset:
    """The filtered log, whose joints that rest know the motion before them as it was before the filter."""
    # A filter lets joints creep while they rest, by more than friction remembers. In motion without rests filtered
    # positions fit filtered torques better: raw ones made a rotor 10 % too small.
    rests = [stays(raw, q).mean() > RESTING for q in joint_positions(raw).T] if raw.time_ordered else [False]
    if not any(rests):
        return filtered
    return replace(filtered, strokes=np.where(np.array(rests)[:, None], strokes(raw), strokes(filtered)))


def _judged(dataset: Dataset, cutoff: float, source: Source) -> tuple[float, dict[float, float]]:
    nv, columns = dataset.nv, 10 * dataset.nv + 10
    rows = int(min(MOST_ROWS, MOST_NUMBERS / (nv * columns)))
    log = dataset.rows(slice(0, rows))
    step = uniform_step(log.time[log.episode == log.episodes[0]])
    tried = [cutoff * factor for factor in FACTORS if cutoff * factor < 0.4 / step]
    if len(log) < 5 * FOLDS * columns // nv or len(tried) < 2:
        raise DatasetError(f"{len(log)} rows are too few to choose a cut-off by prediction.")
    if not log.u.any():
        raise DatasetError("no torque acts, so none shows a cut-off.")
    signals: tuple[Signal, ...] = ("q", "u") if source == "q" else ("q", "v", "u")

    def behind(frequency: float) -> Dataset:
        smooth = differentiated(low_pass(log, frequency, signals=signals), source)
        return with_strokes(with_strokes_of_rests(smooth, log))  # as behind the filter that is chosen

    delay = np.nan_to_num(estimate_delay(behind(cutoff), cutoff, filters=False).common)  # the best guess, sure or not
    log = shifted(log, float(delay))
    away, times = SETTLED / tried[0] + abs(delay), [rows.time for _, rows, _ in episodes_in_order(log)]
    inner = np.concatenate([(time >= time[0] + away) & (time <= time[-1] - away) for time in times])
    sides = [np.concatenate(np.array_split(np.arange(int(inner.sum())), FOLDS)[first::2]) for first in (0, 1)]
    taught = [np.flatnonzero(inner)[side[::4]] for side in sides]
    chosen, sharp = np.union1d(*taught), torque_columns(behind(tried[-1]))
    if len(chosen) <= ROWS_PER_PARAMETER * 10 * nv:  # their columns would be others than those of all rows
        chosen = np.arange(len(log))
    folds = [(np.isin(chosen, own), other) for own, other in zip(taught, sides[::-1], strict=True)]

    def judged(values: Float[np.ndarray, "rows columns"]) -> np.ndarray:
        own = [log.episode == number for number in log.episodes]
        return np.concatenate([LowPass(tried[0])(values[rows], log.time[rows]) for rows in own])[inner]

    measured, shares = judged(log.u), np.empty((len(tried), log.nv))
    found = [judged(each) for each in sharp]
    for k, frequency in enumerate(tried):
        smooth = behind(frequency)
        for joint, each in enumerate(torque_columns(smooth, chosen)):
            size = np.linalg.norm(each, axis=0) + 1e-300
            learned, u, left = each / size, smooth.u[chosen, joint], 0.0
            for one, other in folds:
                theta = np.linalg.lstsq(learned[one], u[one], rcond=1e-2)[0] / size
                left += float(np.square(measured[other, joint] - found[joint][other] @ theta).sum())
            shares[k, joint] = left / max(float(np.square(measured[:, joint]).sum()), 1e-300)
    mean = np.exp(np.log(np.maximum(shares[:, log.u.any(axis=0)], 1e-12)).mean(axis=1))
    best = float(f"{tried[int(np.argmin(mean))]:.3g}")
    return best, {float(f"{f:.3g}"): float(share) for f, share in zip(tried, mean, strict=True)}
