"""Which of the training rows a model learns from: few that lie far apart, and other ones for every seed."""

from __future__ import annotations

import numpy as np

from forcegp.data import Dataset, farthest_rows
from forcegp.errors import InvalidInput

SHARE = 2 / 3
"""Of the training rows among which the points of one seed are chosen."""


def training_subset(train: Dataset, points: int, seed: int) -> Dataset:
    """`points` rows that lie far apart in (q, v, u) among two thirds of the rows, which `seed` draws at random.

    Farthest-point sampling of all rows begins with the same extremes whatever row it starts at, so seeds would hardly
    differ. Among a random two thirds they do, and each choice still covers the states.
    Raises InvalidInput where two thirds of the rows are fewer than `points`.
    """
    if seed < 0:
        raise InvalidInput(f"seed is {seed}; it must be at least 0.")
    among = int(np.ceil(SHARE * len(train)))
    if not 2 <= points <= among:
        raise InvalidInput(
            f"points is {points}; with {len(train)} training rows it must be from 2 to {among}, two thirds of them."
        )
    generator = np.random.default_rng(seed)
    drawn = np.sort(generator.choice(len(train), size=among, replace=False))
    return farthest_rows(train.rows(drawn), points, start=int(generator.integers(among)))
