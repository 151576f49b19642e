"""Forces that repeat over equal ways of a joint: magnets of its motor (cogging), or teeth of its gear."""

import numpy as np
from jaxtyping import Float

FEWEST, FINEST, STEP = 3.0, 300.0, 0.2
"""Repetitions over the reach of a joint: fewest, most, and steps of what is tried."""
REPEATS = 0.5
"""Share of what is left that one wave explains, from which on it is one: of wrong friction it was .26 at most."""
LITTLE = 0.02
"""Share that columns leave of a force, below which no wave is sought."""
PLACES = 2048
"""Bins of the reach, in which a wave is sought first: seven of the finest."""


def rate_of_waves(
    q: Float[np.ndarray, " rows"], force: Float[np.ndarray, " rows"], basis: Float[np.ndarray, "rows k"]
) -> float:
    """The rate [1/rad or 1/m] of a wave over positions that explains most of what orthonormal columns leave of a force.

    It is that of the largest power (Lomb 1976, Scargle 1982); 0 where no wave explains most, and what the best of so
    many would of noise: twice the logarithm of their number over that of the rows.
    """
    reach, left = float(np.ptp(q)), force - basis @ (basis.T @ force)
    left = left - left.mean()
    if not reach > 0.0 or not np.square(left).sum() > LITTLE * np.square(force - force.mean()).sum():
        return 0.0
    from scipy.signal import lombscargle  # half a second, which only few logs should cost

    bins = np.bincount(((q - q.min()) / reach * (PLACES - 1)).round().astype(int), left, PLACES)
    size = round((PLACES - 1) / STEP)  # of which one frequency is a step of repetitions
    tried = np.abs(np.fft.rfft(bins, size))[round(FEWEST / STEP) : round(FINEST / STEP)]
    repetitions = FEWEST + STEP * int(np.argmax(tried)) + np.linspace(-STEP, STEP, 41)  # then closer
    rates = 2.0 * np.pi / reach * repetitions
    found = lombscargle(q - q.mean(), left, rates)
    best, power = float(rates[int(np.argmax(found))]), float(found.max())
    by_chance = 2.0 * np.log(len(tried)) / len(q)
    return best if 2.0 * power > (REPEATS + by_chance) * np.square(left).sum() else 0.0


def waves(q: Float[np.ndarray, " rows"], rate: float) -> Float[np.ndarray, "rows 2"]:
    """Sine and cosine over positions."""
    return np.stack([np.sin(rate * q), np.cos(rate * q)], axis=1)
