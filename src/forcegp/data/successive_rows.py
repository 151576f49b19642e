"""What successive rows show, without a filter: drop-outs, running means, and the noise of the acceleration."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from forcegp.data.dataset import Dataset
from forcegp.data.row_selection import consecutive

JUMP = 10.0  # steps that nine of ten rows stay below, by which a signal that is not measured jumps to 0
LEAST_JUMP = 0.02  # and by more than this share of its range
FEWEST_DROPS = 2
FEW_JOINTS = 3  # of more joints, half as many rows
STRETCHES, STRETCH_ROWS = 3, 400  # of a log that are looked at before a fit, where it is longer
MOTION = 1.5  # ratio of noise as seen by third and by fourth differences above which they see motion instead
FEWEST_DIFFERENCES, MOST_DIFFERENCES = 30, 3000

SMOOTH_SECONDS, SMOOTH_ROWS = 0.03, 15  # of the running mean before a fit: SciPy's filters take half a second to import


def runs(marked: Bool[np.ndarray, " rows"]) -> Int[np.ndarray, "runs 2"]:
    """First rows of all runs of True, and the rows after them."""
    return np.flatnonzero(np.diff(marked, prepend=False, append=False)).reshape(-1, 2)


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
        zeros = runs(x == 0.0)
        zeros = zeros[(zeros[:, 0] > 0) & (zeros[:, 1] <= len(steps))]
        into, out = zeros.T - 1  # the steps that lead into a run of zeros, and out of it
        sudden = (steps[into] > usual) & (steps[out] > usual) & follows[into] & follows[out]
        for start, stop in zeros[sudden] if sudden.sum() >= FEWEST_DROPS else []:
            lost[start:stop, joint] = True
    return lost


def mended_rows(dataset: Dataset, dropped: Mapping[str, np.ndarray]) -> Dataset:
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


def few_stretches(dataset: Dataset) -> Dataset:
    """A few stretches of successive rows, evenly over the log, each an episode."""
    length = STRETCH_ROWS if dataset.nv <= FEW_JOINTS else STRETCH_ROWS // 2
    if len(dataset) <= STRETCHES * length:
        return dataset
    starts = np.linspace(0, len(dataset) - length, STRETCHES).astype(int)
    rows = (starts[:, None] + np.arange(length)).ravel()
    pieces = np.repeat(np.arange(STRETCHES), length)
    _, numbers = np.unique(np.stack([pieces, dataset.episode[rows]]), axis=1, return_inverse=True)
    return replace(dataset.rows(rows), episode=numbers.ravel())


def running_width(dataset: Dataset) -> int:
    """Rows of the running mean of `smoothed`."""
    steps = np.diff(dataset.time)[consecutive(dataset)[:-1]]
    width = int(min(SMOOTH_SECONDS / np.median(steps), SMOOTH_ROWS)) // 2 * 2 + 1 if len(steps) else 1
    return width if len(dataset) >= 10 * width else 1


def smoothed(dataset: Dataset) -> Dataset:
    """Running means of all signals within each episode, of one length for all: the equation of motion keeps holding."""
    width = running_width(dataset)
    inside = whole_windows(dataset, width)
    if width < 3 or not len(inside):
        return dataset
    means = {name: _means(getattr(dataset, name), inside, width) for name in ("q", "v", "u", "a")}
    rows = dataset.rows(inside + width // 2)
    return replace(rows, **means, noise_std=None, truth={})


def whole_windows(dataset: Dataset, width: int) -> np.ndarray:
    """First rows of the windows of so many rows that lie within an episode."""
    breaks = np.cumsum(np.insert(~consecutive(dataset), 0, False))
    first = np.arange(max(0, len(dataset) - width + 1))
    return first[breaks[first + width - 1] == breaks[first]]


def _means(values: np.ndarray, first: np.ndarray, width: int) -> np.ndarray:
    sums = np.cumsum(np.insert(values, 0, 0.0, axis=0), axis=0)
    return (sums[first + width] - sums[first]) / width


def white_noise(log: Dataset, width: int = 1, signal: str = "a") -> Float[np.ndarray, " nv"] | None:
    """Standard deviation of noise on a signal, or on its means over `width` rows, from differences of successive ones.

    The k-th difference of white noise has the variance binomial(2k, k), that of a smooth motion falls with k: NaN where
    it is motion that is seen. Medians, since impacts are no noise. None for rows out of order and fewer than 30.
    """
    if not log.time_ordered:
        return None
    noise = []
    for order, variance in ((3, 20.0), (4, 70.0)):
        first = whole_windows(log, width * (order + 1))
        if len(first) < FEWEST_DIFFERENCES:
            return None
        first = first[:: max(1, len(first) // MOST_DIFFERENCES)]
        means = np.stack([_means(getattr(log, signal), first + k * width, width) for k in range(order + 1)])
        differences = np.diff(means, order, axis=0)[0]
        noise.append(1.4826 * np.median(np.abs(differences), axis=0) / np.sqrt(variance))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where((noise[0] < MOTION * noise[1]) & (noise[1] > 0.0), noise[1], np.nan)
