"""Posterior of the latent functions given the deflated data: mean (n, C) and covariance (n, C, C) at new points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.inference.deflation import deflate, whiten
from forcegp.inference.kernels import LatentKernels, kernel_cross, kernel_diagonal
from forcegp.inference.likelihood import DeflatedSystem, solve_deflated

BLOCK_BYTES = 64 * 2**20
"""Working memory of one block of test points."""


@dataclass(frozen=True, eq=False)
class LatentPosterior:
    """p(f_1(z_1), ..., f_C(z_C) | data), exact."""

    kernels: LatentKernels
    features: tuple[Float[Tensor, "N _"], ...]
    system: DeflatedSystem

    @classmethod
    def condition(
        cls,
        kernels: LatentKernels,
        features: Sequence[Float[Tensor, "N _"]],
        W: Float[Tensor, "N D C"],
        residual: Float[Tensor, "N D"],
        noise: Float[Tensor, "#N D"] | Float[Tensor, "#N D D"],
    ) -> LatentPosterior:
        """Condition on residual = y - m; the arguments are those of `negative_log_likelihood`."""
        with torch.no_grad():
            W_white, y_white, _ = whiten(W, residual, noise)
            system = solve_deflated(deflate(W_white, y_white), kernels(features))
        return cls(kernels, tuple(z.detach() for z in features), system)

    def mean(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C"]:
        """E f_c = sum_j k_c(z, z_j) beta_jc (Rasmussen & Williams 2006, eq. 2.25); differentiable in the features."""
        beta = self.system.beta
        columns = [
            kernel_cross(kernel, z, z_train) @ beta[:, c]
            for c, (kernel, z, z_train) in enumerate(zip(self.kernels, features, self.features, strict=True))
        ]
        return torch.stack(columns, dim=-1)

    def covariance(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C C"]:
        """Cov(f_c, f_d) = k_c(z, z) delta_cd - V_c^T V_d with V_c = L^-1 [k_c(z, z_j) C_jac].

        Source: Rasmussen & Williams (2006), eq. 2.26.
        """
        C = self.system.deflation.C
        count, rank, latents = C.shape
        points = features[0].shape[0]
        height = max(1, BLOCK_BYTES // max(1, 8 * count * rank * latents))
        blocks = [
            self._covariance_block([z[start : start + height] for z in features]) for start in range(0, points, height)
        ]
        return torch.cat(blocks) if blocks else C.new_zeros(0, latents, latents)

    def one(self, index: int, z: Float[Tensor, "n _"]) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Mean and variance of one latent at points of its own features."""
        kernel, C = list(self.kernels)[index], self.system.deflation.C
        cross = kernel_cross(kernel, z, self.features[index])
        V = (cross.mT[:, None, :] * C[:, :, index, None]).flatten(0, 1)
        explained = self.system.factor.solve_lower(V).square().sum(0)
        return cross @ self.system.beta[:, index], kernel_diagonal(kernel, z) - explained

    def _covariance_block(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C C"]:
        C = self.system.deflation.C
        count, rank, latents = C.shape
        cross = torch.stack(
            [kernel_cross(k, z, z_train) for k, z, z_train in zip(self.kernels, features, self.features, strict=True)]
        )
        points = cross.shape[1]
        V = torch.einsum("cnj,jac->jacn", cross, C).reshape(count * rank, latents * points)
        V = self.system.factor.solve_lower(V).reshape(count * rank, latents, points).permute(2, 1, 0)
        prior = torch.stack([kernel_diagonal(k, z) for k, z in zip(self.kernels, features, strict=True)], dim=-1)
        return torch.diag_embed(prior) - V @ V.mT
