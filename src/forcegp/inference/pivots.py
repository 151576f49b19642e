"""Pivoted Cholesky: the points of which a kernel matrix is nearly made, and how much of it they leave out."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from forcegp.inference.dense_kernels import DenseKernel

ROUNDING = 1e-13
"""Remainders below this fraction of the largest k(z, z) are rounding."""


@dataclass(frozen=True, eq=False)
class Pivots:
    """K ~ rows^T rows (N, N) from the points `indices`; `remainder` is the diagonal of what is left, never negative.

    `rows` is (m, N); its columns at the pivots are the transposed Cholesky factor of their own kernel matrix.
    """

    indices: Int[Tensor, " m"]
    rows: Float[Tensor, "m N"]
    remainder: Float[Tensor, " N"]

    @property
    def lower(self) -> Float[Tensor, "m m"]:
        """The lower Cholesky factor of k(z_p, z_p) at the pivots p."""
        return self.rows[:, self.indices].mT.tril()


def pivoted_cholesky(
    kernel: DenseKernel, z: Float[Tensor, "N d"], relevance: Float[Tensor, " N"], most: int, tolerance: float = 0.0
) -> Pivots:
    """Greedy pivots, each where the relevance times what is left of k(z, z) is largest.

    At most `most` of them; fewer where the sum of relevance times remainder falls below `tolerance`, or nothing but
    rounding is left. Time O(N m^2), memory O(N m).
    Source: Fine & Scheinberg (2001), "Efficient SVM training using low-rank kernel representations"; Harbrecht, Peters
    & Schneider (2012), "On the low-rank approximation by the pivoted Cholesky decomposition".
    """
    with torch.no_grad():
        remainder = kernel.diagonal(z).clone()
        count = len(z)
        rows = z.new_empty(min(most, count), count)
        indices: list[int] = []
        floor = ROUNDING * float(remainder.max()) if count else 0.0
        while len(indices) < len(rows):
            score = relevance * remainder
            pivot = int(score.argmax())
            if float(score.sum()) <= tolerance or float(remainder[pivot]) <= floor:
                break
            done = len(indices)
            column = kernel.cross(z[pivot : pivot + 1], z)[0]
            column = column - rows[:done].mT @ rows[:done, pivot]
            rows[done] = column / column[pivot].clamp_min(floor).sqrt()
            rows[done, indices] = 0.0  # exactly, so that `lower` is triangular
            remainder = (remainder - rows[done].square()).clamp_min_(0.0)
            remainder[pivot] = 0.0
            indices.append(pivot)
        return Pivots(torch.tensor(indices, dtype=torch.long, device=z.device), rows[: len(indices)], remainder)
