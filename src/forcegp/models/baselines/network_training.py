"""What training by batches needs: rows in random order, and rows held out by stretches of time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from forcegp.data import Dataset

BLOCKS = 20
"""Stretches of time that a recording is cut into; a share of them is held out."""


class Batches:
    """Batches of row numbers, for several members at once: each goes through its own rows in its own random order."""

    def __init__(self, rows: Sequence[Int[Tensor, " rows"]], size: int, generator: torch.Generator) -> None:
        self.rows = list(rows)
        self.size = min(size, *(len(each) for each in rows)) if len(rows) > 1 else min(size, len(rows[0]))
        self.generator = generator
        self.orders = [each[:0] for each in self.rows]

    def draw(self) -> Int[Tensor, "members size"]:
        """The next batch of every member; the rest of a pass that fills no batch is left out."""
        chosen = []
        for member, rows in enumerate(self.rows):
            if len(self.orders[member]) < self.size:
                self.orders[member] = rows[torch.randperm(len(rows), generator=self.generator)]
            chosen.append(self.orders[member][: self.size])
            self.orders[member] = self.orders[member][self.size :]
        return torch.stack(chosen)


def held_out_rows(
    rows: Dataset, members: int, share: float, seed: int
) -> tuple[list[Int[Tensor, " train"]], list[Int[Tensor, " held"]]]:
    """Rows to train on and rows held out, for every member: other stretches of time, of about `share` of the rows.

    Neighbours in time are nearly equal, so single rows that are held out would be known by heart. Lengths are equal
    for all members.
    """
    order = np.lexsort((rows.time, rows.episode))
    blocks = np.array_split(order, min(BLOCKS, len(order) // 2))
    count = max(1, round(share * len(blocks)))
    training, held_out = [], []
    for member in range(members):
        chosen = set(np.random.default_rng((seed, member)).permutation(len(blocks))[:count].tolist())
        held_out.append(np.concatenate([block for k, block in enumerate(blocks) if k in chosen]))
        training.append(np.concatenate([block for k, block in enumerate(blocks) if k not in chosen]))
    return _equal_lengths(training), _equal_lengths(held_out)


def _equal_lengths(parts: Sequence[np.ndarray]) -> list[Tensor]:
    shortest = min(len(part) for part in parts)  # blocks differ by one row
    return [torch.tensor(part[:shortest]) for part in parts]
