"""How noisy accelerations and forces are, from the residuals of forward dynamics.

Residuals r_n = a_n - a^_n that have noise of both kinds are normal with covariance

    S_n = diag(sigma_a^2) + M_n^-1 diag(sigma_F^2) M_n^-1,

so joints of small inertia count less where the noise is one of forces. The two levels of every joint are those of
largest likelihood (the model of `forcegp.models.Noise`). One level per joint would let rows of large M^-1 decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize
from torch import Tensor

ROWS = 2000
"""Rows that levels are found from at most, evenly spread."""
LEAST = 1e-3
"""Smallest standard deviation, relative to that of all residuals."""


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Standard deviations per joint: of accelerations [rad/s^2 or m/s^2] and of forces [Nm or N]."""

    acceleration: Float[np.ndarray, " nv"]
    force: Float[np.ndarray, " nv"]

    @classmethod
    def of(cls, residual: Float[np.ndarray, "rows nv"], M: Float[np.ndarray, "rows nv nv"]) -> NoiseLevels:
        """Those of largest likelihood, by L-BFGS on their logarithms, each at least `LEAST` of the whole."""
        chosen = np.unique(np.linspace(0, len(residual) - 1, min(ROWS, len(residual))).astype(int))
        r, inverse = (torch.as_tensor(x) for x in (residual[chosen], np.linalg.inv(M[chosen])))
        in_force = torch.linalg.solve(inverse, r[..., None])[..., 0]
        whole = torch.stack([x.square().mean(0).sqrt().clamp_min(1e-12) for x in (r, in_force)])
        start = np.full(whole.numel(), np.log(0.5))

        def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
            logs = torch.tensor(x, requires_grad=True)
            acceleration, force = whole * logs.view_as(whole).exp()
            lower = torch.linalg.cholesky(_covariance(inverse, acceleration, force))
            white = torch.linalg.solve_triangular(lower, r[..., None], upper=False)
            # a weak pull to the start keeps a level that the residuals do not inform from running away
            pull = 0.5 * (logs - torch.as_tensor(start)).square().sum()
            value = 0.5 * white.square().sum() + lower.diagonal(dim1=-2, dim2=-1).log().sum() + pull
            (gradient,) = torch.autograd.grad(value, logs)
            return float(value.detach()), gradient.numpy()

        # scipy's search, since the import of torch.optim takes seconds
        found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=[(np.log(LEAST), None)] * len(start))
        acceleration, force = whole.numpy() * np.exp(found.x).reshape(whole.shape)
        return cls(acceleration, force)

    def whitening(self, M: Float[np.ndarray, "rows nv nv"]) -> Float[np.ndarray, "rows nv nv"]:
        """L_n^-1 with S_n = L_n L_n^T: residuals times this have the identity as covariance."""
        inverse = torch.as_tensor(np.linalg.inv(M))
        S = _covariance(inverse, torch.as_tensor(self.acceleration), torch.as_tensor(self.force))
        return np.linalg.inv(torch.linalg.cholesky(S).numpy())


def _covariance(inverse: Tensor, acceleration: Tensor, force: Tensor) -> Tensor:
    return torch.diag_embed(acceleration.square()).expand_as(inverse) + (inverse * force.square()) @ inverse.mT
