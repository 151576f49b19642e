"""Gaussian processes as finitely many weights: k_c(z, z') ~ phi_c(z) . phi_c(z') with phi_c(z) = L_c^-1 k_c(p_c, z).

The points p_c of latent c are a few of the training points, L_c the Cholesky factor of their kernel matrix, so that the
weights w_c are standard normal a priori. With the deflated data t_i = sum_c C_ic f_c(z_i) + noise of covariance D_i
(r x r), the weights of all latents together have the precision

    B = I + Phi^T D^-1 Phi,      Phi[i, (c, p)] = C_ic phi_cp(z_i).

D = I is the variational posterior of Titsias (2009, "Variational learning of inducing variables in sparse Gaussian
processes"); D_i = I + sum_c C_ic C_ic^T (k_c(z_i, z_i) - |phi_c(z_i)|^2) gives the points what the weights leave out as
noise of their own, the fully independent training conditional of Snelson & Ghahramani (2006).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.inference.cholesky import CholeskyFactor, factorize
from forcegp.inference.kernels import LatentKernels, kernel_cross, kernel_diagonal
from forcegp.inference.pivots import Pivots

BLOCK_BYTES = 64 * 2**20
"""Working memory of one block of points."""


@dataclass(frozen=True, eq=False)
class WeightSpace:
    """The weights of all latents, conditioned on deflated data.

    `points` and `lowers` are p_c and L_c, `precision` the Cholesky factor of B; the weights of the latents follow each
    other.
    """

    kernels: LatentKernels
    points: tuple[Float[Tensor, "_ _"], ...]
    lowers: tuple[Float[Tensor, "_ _"], ...]
    precision: CholeskyFactor

    @classmethod
    def of(
        cls,
        kernels: LatentKernels,
        features: Sequence[Float[Tensor, "N _"]],
        pivots: Sequence[Pivots],
        C: Float[Tensor, "N r C"],
        noise_precision: Float[Tensor, "N r r"] | None = None,
    ) -> WeightSpace:
        """Condition on the points of `pivots`; the precision D^-1 of the noise is that of white noise for None."""
        white = C if noise_precision is None else noise_precision @ C
        pairs = (C[..., :, None] * white[..., None, :]).sum(1)  # C_i^T D_i^-1 C_i
        slices = _slices([len(found.indices) for found in pivots])

        def build() -> Tensor:
            B = torch.eye(slices[-1].stop if slices else 0, dtype=C.dtype, device=C.device)
            for c, left in enumerate(pivots):
                for d, right in enumerate(pivots[: c + 1]):
                    B[slices[c], slices[d]] += _weighted_product(left.rows, pairs[:, c, d], right.rows)
            return B

        points = tuple(z[found.indices].detach() for z, found in zip(features, pivots, strict=True))
        return cls(kernels, points, tuple(found.lower for found in pivots), factorize(build))

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Which of all weights belong to each latent."""
        return _slices([len(lower) for lower in self.lowers])

    def columns(self, features: Sequence[Float[Tensor, "n _"]]) -> list[Float[Tensor, "_ n"]]:
        """phi_c at points, one column each."""
        return [self.column(c, z) for c, z in enumerate(features)]

    def column(self, index: int, z: Float[Tensor, "n d"]) -> Float[Tensor, "m n"]:
        """phi_c of one latent at points of its own features."""
        cross = kernel_cross(self.kernels[index], self.points[index], z)
        return torch.linalg.solve_triangular(self.lowers[index], cross, upper=False)

    def center_weights(self, weights: Float[Tensor, "P S"]) -> list[Float[Tensor, "_ S"]]:
        """Weights w_c of the features phi_c as those of the kernel functions about the points p_c: L_c^-T w_c."""
        return [
            torch.linalg.solve_triangular(lower.mT, weights[part], upper=True)
            for lower, part in zip(self.lowers, self.slices, strict=True)
        ]

    def covariance(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C C"]:
        """Cov(f_c, f_d) at the same point: what the weights leave out of k_c, and Phi_z B^-1 Phi_z^T."""
        total, latents = self.slices[-1].stop, len(self.points)
        height = max(1, BLOCK_BYTES // max(1, 8 * total * latents))
        count = len(features[0])
        blocks = [self._covariance_block([z[i : i + height] for z in features]) for i in range(0, count, height)]
        return torch.cat(blocks) if blocks else features[0].new_zeros(0, latents, latents)

    def _covariance_block(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C C"]:
        count, latents = len(features[0]), len(self.points)
        wide = features[0].new_zeros(self.slices[-1].stop, latents, count)
        remainders = []
        for c, (part, phi) in enumerate(zip(self.slices, self.columns(features), strict=True)):
            wide[part, c] = phi
            diagonal = kernel_diagonal(self.kernels[c], features[c])
            remainders.append((diagonal - phi.square().sum(0)).clamp_min(0.0))
        V = self.precision.solve_lower(wide.flatten(1)).unflatten(1, (latents, count)).permute(2, 1, 0)
        return torch.diag_embed(torch.stack(remainders, dim=-1)) + V @ V.mT

    def variance_of(self, index: int, z: Float[Tensor, "n d"]) -> Float[Tensor, " n"]:
        """Variance of one latent at points of its own features."""
        phi = self.column(index, z)
        wide = phi.new_zeros(self.slices[-1].stop, len(z))
        wide[self.slices[index]] = phi
        remainder = (kernel_diagonal(self.kernels[index], z) - phi.square().sum(0)).clamp_min(0.0)
        return remainder + self.precision.solve_lower(wide).square().sum(0)


def _slices(sizes: Sequence[int]) -> tuple[slice, ...]:
    parts, start = [], 0
    for size in sizes:
        parts.append(slice(start, start + size))
        start += size
    return tuple(parts)


def _weighted_product(
    left: Float[Tensor, "m N"], weights: Float[Tensor, " N"], right: Float[Tensor, "k N"]
) -> Float[Tensor, "m k"]:
    """left diag(weights) right^T, some columns at a time."""
    width = max(1, BLOCK_BYTES // max(1, 8 * len(left)))
    total = left.new_zeros(len(left), len(right))
    for start in range(0, left.shape[1], width):
        part = slice(start, start + width)
        total.addmm_(left[:, part] * weights[part], right[:, part].mT)
    return total
