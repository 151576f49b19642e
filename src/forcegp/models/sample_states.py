"""States like those of the training data, and between and around them, where a covariance is compressed and checked."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.models.marginal_likelihood import TrainingData

STEP = 0.3
"""Length of a step away from a training state, in differences of two others."""


def sample_states(training: TrainingData, count: int, seed: int) -> list[Float[Tensor, "count nv"]]:
    """q, v and u of `count` states, a third of each of three kinds.

    Training rows; rows moved by a fraction of the difference of two others; positions, velocities and forces of
    different rows together.
    """
    generator = torch.Generator().manual_seed(seed)
    rows = [training.q, training.v, training.u]

    def some(number: int) -> Tensor:
        return torch.randint(len(training.q), (number,), generator=generator)

    own, apart = count // 3, count - 2 * (count // 3)
    i, j, k = some(own), some(own), some(own)
    mixed = [some(apart) for _ in rows]
    return [
        torch.cat([x[some_rows], x[i] + STEP * (x[j] - x[k]), x[other]])
        for some_rows in [torch.randperm(len(rows[0]), generator=generator)[:own]]
        for x, other in zip(rows, mixed, strict=True)
    ]
