"""Stretches of time: rows that belong together because they were measured one after the other.

Neighbouring rows of one motion are nearly equal, so a row that is left out alone is still known from its neighbours.
Leaving whole stretches out tests the prediction of a part of the motion that it has not seen (block
cross-validation; Burman, Chow & Nolan 1994, "A cross-validatory method for dependent data").
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from forcegp.errors import InvalidInput


def time_blocks(
    time: Float[np.ndarray, " rows"], episode: Int[np.ndarray, " _"], seconds: float
) -> tuple[tuple[int, ...], ...]:
    """Row numbers in blocks: rows of one episode in one stretch of `seconds` form a block, in order of time.

    `time` [s] and `episode` may come in any order, such as that of `farthest_rows`. Stretches are counted from the
    first of these rows in every episode; those without rows give no block, so that every row is in exactly one.
    Raises InvalidInput for a length that is not positive and finite, and for columns of different lengths.
    """
    if not 0.0 < seconds < float("inf"):
        raise InvalidInput(f"seconds is {seconds}; it must be positive and finite.")
    if time.shape != episode.shape:
        raise InvalidInput(f"time has {len(time)} rows and episode {len(episode)}; give both for the same rows.")
    blocks: dict[tuple[int, int], list[int]] = {}
    first = {int(number): float(time[episode == number].min()) for number in np.unique(episode)}
    for row in np.lexsort((time, episode)):
        number = int(episode[row])
        stretch = int((time[row] - first[number]) / seconds)
        blocks.setdefault((number, stretch), []).append(int(row))
    return tuple(tuple(rows) for rows in blocks.values())
