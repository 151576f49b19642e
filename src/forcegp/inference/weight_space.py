"""Gaussian processes as finitely many weights: k_c(z, z') ~ phi_c(z) . phi_c(z') with phi_c(z) = L_c^-1 k_c(p_c, z).

The points p_c of latent c are a few of the training points, chosen by pivoted Cholesky, L_c the
Cholesky factor of their kernel matrix, so that the weights w_c are standard normal a priori. With the deflated data
t_i = sum_c C_ic f_c(z_i) + noise of covariance D_i (r x r), the weights of all latents together have the precision

    B = I + Phi^T D^-1 Phi,      Phi[i, (c, p)] = C_ic phi_cp(z_i).

D = I is the variational posterior of Titsias (2009, "Variational learning of inducing variables in sparse Gaussian
processes"); D_i = I + sum_c C_ic C_ic^T (k_c(z_i, z_i) - |phi_c(z_i)|^2) gives the points what the weights leave out as
noise of their own, the fully independent training conditional of Snelson & Ghahramani (2006).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from forcegp.inference.cholesky import CholeskyFactor, factorize
from forcegp.inference.dense_kernels import DenseKernel
from forcegp.inference.kernels import LatentKernels

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


BLOCK_BYTES = 64 * 2**20
"""Working memory of one block of points."""


@dataclass(frozen=True, eq=False)
class WeightSpace:
    """The weights of all latents, conditioned on deflated data; the weights of the latents follow each other.

    `points` and `lowers` are p_c and L_c, `precision` the Cholesky factor of B, `mean` the posterior mean of the
    weights, `left_out` what they leave out of the prior variance of a row in units of the noise: the mean over rows of
    the sum over latents of |C_ic|^2 (k_c(z_i, z_i) - |phi_c(z_i)|^2).
    """

    kernels: LatentKernels
    points: tuple[Float[Tensor, "_ _"], ...]
    lowers: tuple[Float[Tensor, "_ _"], ...]
    precision: CholeskyFactor
    mean: Float[Tensor, " P"]
    left_out: float

    @classmethod
    def of(
        cls,
        kernels: LatentKernels,
        features: Sequence[Float[Tensor, "N _"]],
        points: Sequence[Float[Tensor, "_ _"]],
        C: Float[Tensor, "N r C"],
        t: Float[Tensor, "N r"],
        noise_precision: Float[Tensor, "N r r"] | None = None,
    ) -> WeightSpace:
        """Condition on all rows; None for the noise precision D^-1 is white noise.

        Time O(N P^2), memory O(P^2) and a block of rows. Raises NumericalError where the kernel matrix of the points
        cannot be factorised.
        """
        points = tuple(z.detach() for z in points)
        lowers = tuple(
            factorize(partial(kernel.cross, z, z)).lower.tril() for kernel, z in zip(kernels.dense, points, strict=True)
        )
        prior = cls(kernels, points, lowers, CholeskyFactor(C.new_zeros(0, 0)), C.new_zeros(0), 0.0)
        white, slices = C if noise_precision is None else noise_precision @ C, prior.slices
        pairs = (C[..., :, None] * white[..., None, :]).sum(1)  # C_i^T D_i^-1 C_i
        target = (white * t[..., None]).sum(1)  # C_i^T D_i^-1 t_i
        relevance = C.square().sum(1)
        B = torch.eye(prior.count, dtype=C.dtype, device=C.device)
        right, left_out = C.new_zeros(prior.count), C.new_zeros(())
        height = max(1, BLOCK_BYTES // (8 * max(1, prior.count)))
        for start in range(0, len(C), height):
            rows = slice(start, start + height)
            block = [z[rows] for z in features]
            phi = prior.columns(block)
            for c, left in enumerate(phi):
                remainder = kernels.dense[c].diagonal(block[c]) - left.square().sum(0)
                left_out += relevance[rows, c] @ remainder.clamp_min(0.0)
                right[slices[c]] += left @ target[rows, c]
                for d, other in enumerate(phi[: c + 1]):
                    B[slices[c], slices[d]] += (left * pairs[rows, c, d]) @ other.mT
        precision = factorize(B.clone)
        mean = precision.solve(right[:, None])[:, 0] if prior.count else right
        return cls(kernels, points, lowers, precision, mean, float(left_out) / max(1, len(C)))

    @property
    def count(self) -> int:
        """The number of weights, P."""
        return sum(len(lower) for lower in self.lowers)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Which of all weights belong to each latent."""
        return _slices([len(lower) for lower in self.lowers])

    def columns(self, features: Sequence[Float[Tensor, "n _"]]) -> list[Float[Tensor, "_ n"]]:
        """phi_c at points, one column each."""
        return [self.column(c, z) for c, z in enumerate(features)]

    def column(self, index: int, z: Float[Tensor, "n d"]) -> Float[Tensor, "m n"]:
        """phi_c of one latent at points of its own features."""
        cross = self.kernels.dense[index].cross(self.points[index], z)
        return torch.linalg.solve_triangular(self.lowers[index], cross, upper=False)

    def center_weights(self, weights: Float[Tensor, "P S"]) -> list[Float[Tensor, "_ S"]]:
        """Weights w_c of the features phi_c as those of the kernel functions about the points p_c: L_c^-T w_c."""
        return [
            torch.linalg.solve_triangular(lower.mT, weights[part], upper=True)
            for lower, part in zip(self.lowers, self.slices, strict=True)
        ]

    def covariance(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C C"]:
        """Cov(f_c, f_d) at the same point: what the weights leave out of k_c, and Phi_z B^-1 Phi_z^T."""
        total, latents = self.count, len(self.points)
        height = max(1, BLOCK_BYTES // max(1, 8 * total * latents))
        count = len(features[0])
        blocks = [self._covariance_block([z[i : i + height] for z in features]) for i in range(0, count, height)]
        return torch.cat(blocks) if blocks else features[0].new_zeros(0, latents, latents)

    def _covariance_block(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C C"]:
        count, latents = len(features[0]), len(self.points)
        wide = features[0].new_zeros(self.count, latents, count)
        remainders = []
        for c, (part, phi) in enumerate(zip(self.slices, self.columns(features), strict=True)):
            wide[part, c] = phi
            diagonal = self.kernels.dense[c].diagonal(features[c])
            remainders.append((diagonal - phi.square().sum(0)).clamp_min(0.0))
        V = self.precision.solve_lower(wide.flatten(1)).unflatten(1, (latents, count)).permute(2, 1, 0)
        return torch.diag_embed(torch.stack(remainders, dim=-1)) + V @ V.mT

    def variance_of(self, index: int, z: Float[Tensor, "n d"]) -> Float[Tensor, " n"]:
        """Variance of one latent at points of its own features."""
        phi = self.column(index, z)
        wide = phi.new_zeros(self.count, len(z))
        wide[self.slices[index]] = phi
        remainder = (self.kernels.dense[index].diagonal(z) - phi.square().sum(0)).clamp_min(0.0)
        return remainder + self.precision.solve_lower(wide).square().sum(0)


def _slices(sizes: Sequence[int]) -> tuple[slice, ...]:
    parts, start = [], 0
    for size in sizes:
        parts.append(slice(start, start + size))
        start += size
    return tuple(parts)
