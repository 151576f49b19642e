"""Deflation: an exact change of variables that shrinks the covariance from DN x DN to rN x rN.

The model is y_i = m_i + W_i f(x_i) + noise_i with D outputs, C latent functions and noise covariance R_i = L_i L_i^T.
In whitened coordinates, y~_i = L_i^-1 (y_i - m_i) and W~_i = L_i^-1 W_i = U_i C_i with orthonormal U_i (D x r). The
part of y~_i orthogonal to U_i does not depend on the latents and is standard normal; U_i^T y~_i carries everything that
the data hold about them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import NumericalError

RANK_TOLERANCE = 1e-12
"""Singular values of W~_i below this fraction of the largest one count as zero (they come from rounding in H A^T =
0).
"""


@dataclass(frozen=True, eq=False)
class Deflation:
    """W~_i = U_i C_i, t_i = U_i^T y~_i and the remainder y~_i - U_i t_i, for N points."""

    U: Float[Tensor, "N D r"]
    C: Float[Tensor, "N r C"]
    t: Float[Tensor, "N r"]
    remainder: Float[Tensor, "N D"]

    @property
    def rank(self) -> int:
        """The largest rank of W_i over the points (r)."""
        return self.C.shape[-2]

    def columns(self, index: int, cross: Float[Tensor, "n N"]) -> Float[Tensor, "Nr n"]:
        """Covariance of t with one latent at n points, from its kernel function `cross` between these and all rows."""
        return (cross.mT[:, None, :] * self.C[:, :, index, None]).flatten(0, 1)

    def drawn_weights(
        self,
        prior: Sequence[Float[Tensor, "S N"]],
        generator: torch.Generator,
        solve: Callable[[Tensor], Tensor],
        jitter: float = 0.0,
    ) -> tuple[Float[Tensor, "S N"], ...]:
        """Matheron's rule: C^T T^-1 (t - C g_s - eps_s) with eps_s ~ N(0, 1 + jitter) and `solve` for T^-1."""
        residual = self.t - torch.einsum("jac,csj->sja", self.C, torch.stack(list(prior)))
        noise = torch.randn(residual.shape, generator=generator, dtype=self.C.dtype, device=self.C.device)
        residual = residual - math.sqrt(1.0 + jitter) * noise
        alpha = solve(residual.flatten(1).mT.contiguous()).mT.reshape(residual.shape)
        return torch.einsum("jac,sja->csj", self.C, alpha).unbind(0)


def whiten(
    W: Float[Tensor, "N D C"], residual: Float[Tensor, "N D"], noise: Float[Tensor, "#N D"] | Float[Tensor, "#N D D"]
) -> tuple[Float[Tensor, "N D C"], Float[Tensor, "N D"], Float[Tensor, ""]]:
    """W~ = L^-1 W, y~ = L^-1 residual and sum_i log|L_i| for noise variances (N or 1, D) or covariances (N or 1, D, D).

    Differentiable in all arguments. Raises NumericalError when a noise covariance is not positive definite.
    """
    count = W.shape[0]
    if noise.ndim == 2:
        if not bool((noise > 0).all()):
            raise NumericalError(f"noise variances must be positive, the smallest is {float(noise.detach().min()):.3e}")
        std = noise.sqrt()
        return W / std[..., None], residual / std, std.log().expand(count, -1).sum()
    lower, info = torch.linalg.cholesky_ex(noise)
    if bool((info != 0).any()):
        raise NumericalError(
            f"the noise covariance of row {int(torch.nonzero(info)[0])} is not positive definite; raise the "
            "acceleration noise"
        )
    logdet = lower.diagonal(dim1=-2, dim2=-1).log().sum(-1).expand(count).sum()
    W_white = torch.linalg.solve_triangular(lower, W, upper=False)
    residual_white = torch.linalg.solve_triangular(lower, residual[..., None], upper=False)[..., 0]
    return W_white, residual_white, logdet


def deflate(W_white: Float[Tensor, "N D C"], y_white: Float[Tensor, "N D"]) -> Deflation:
    """Split whitened data into what depends on the latents and what does not.

    The rank r is found from the data. U_i comes from the singular value decomposition of W~_i. Points of lower rank
    than the largest keep orthonormal columns with zero rows in C_i, which is exact too. Not differentiable on its own:
    `negative_log_likelihood` carries the gradients, which do not depend on the choice of basis. Raises
    NumericalError where W~ or y~ is not finite.
    """
    with torch.no_grad():
        if not bool(torch.isfinite(W_white).all() & torch.isfinite(y_white).all()):  # one wait for a GPU, not two
            _require_finite(W_white, "the mixing vectors W", "check q, v, u and the contact geometry")
            _require_finite(y_white, "the residuals y - m", "check the measured accelerations and the mean")
        U, singular, _ = torch.linalg.svd(W_white, full_matrices=False)
        rank = 0
        if singular.numel():
            rank = int((singular > RANK_TOLERANCE * singular.amax(dim=-1, keepdim=True)).sum(-1).max())
        U = U[..., :rank].contiguous()
        C = U.mT @ W_white
        t = (U.mT @ y_white[..., None])[..., 0]
        remainder = y_white - (U @ t[..., None])[..., 0]
    return Deflation(U, C, t, remainder)


def _require_finite(values: Tensor, what: str, remedy: str) -> None:
    finite = torch.isfinite(values)
    if not bool(finite.all()):
        raise NumericalError(f"{what} of row {int(torch.nonzero(~finite)[0, 0])} are not finite; {remedy}")


class Terms(NamedTuple):
    """Features z_c (N, d_c) of every latent, W (N, D, C), residual y - m (N, D), and the noise.

    `noise` holds variances (N or 1, D) or covariance matrices (N or 1, D, D).
    """

    features: list[Tensor]
    W: Tensor
    residual: Tensor
    noise: Tensor

    def deflated(self) -> Deflation:
        """Whitened, and split into what depends on the latents and what does not."""
        W_white, y_white, _ = whiten(self.W, self.residual, self.noise)
        return deflate(W_white, y_white)
