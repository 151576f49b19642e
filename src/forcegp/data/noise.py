"""Noise of a signal, from differences of successive rows."""

import numpy as np
from jaxtyping import Float

from forcegp.data.dataset import Dataset
from forcegp.data.views import whole_windows, window_means

MOTION = 1.5  # ratio of noise as seen by third and by fourth differences above which they see motion instead
FEWEST_DIFFERENCES, MOST_DIFFERENCES = 30, 3000


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
        means = np.stack([window_means(getattr(log, signal), first + k * width, width) for k in range(order + 1)])
        differences = np.diff(means, order, axis=0)[0]
        noise.append(1.4826 * np.median(np.abs(differences), axis=0) / np.sqrt(variance))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where((noise[0] < MOTION * noise[1]) & (noise[1] > 0.0), noise[1], np.nan)
