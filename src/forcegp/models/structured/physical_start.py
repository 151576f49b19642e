"""Where the search for physical parameters begins, and in which units it steps.

Masses, centres of mass and friction coefficients change the objective by many orders of magnitude more than the
logarithms of kernel parameters do; and as long as they are wrong, the variances from moments of the residual are so
large that the processes explain the error away. So before the search of a model with the analytical mean, a few
Gauss-Newton steps lower

    1/2 s^T G s + 1/2 sum_i e_i^T S_i^-1 e_i,    e = P M (a - m) = P (M a - Q_K),    P = I - A^+ A,

the weighted least squares of inverse dynamics where the contacts do not act. Other than a - m, e is linear in mass,
first moments and inertias (Atkeson, An & Hollerbach 1986). S_i = P (M R M + B diag(k_c(x_i, x_i)) B^T) P takes rows as
independent, with variances k_c from the moments of the residual, which are taken again before every step. G is 1, and
the curvature of the prior on inertias where there is one. A model with mean "zero" does not trust Q_K, so its estimate
may not rest on it either: that search begins at the values of the given system.

The units come from the information where the search begins, of rows with covariances
S_i = R_i + W_i diag(k_c(x_i, x_i)) W_i^T:

    F = G + sum_i J_i^T S_i^-1 J_i + 1/2 tr(S_i^-1 dS_i S_i^-1 dS_i),    J = d(a - m)/ds

(Fisher information of normal distributions whose mean and covariance depend on s; Kay 1993, eq. 3.31). With F = L L^T
the search moves z, s = L^-T z. None of this changes what the objective is.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import FitError, NumericalError
from forcegp.inference import LatentKernels
from forcegp.models.identification.physical_parameters import PHYSICAL, Learned, PhysicalParameters, inertials_of
from forcegp.models.structured.marginal_likelihood import MarginalLikelihood
from forcegp.models.structured.search import relative_inertia
from forcegp.robots import pseudo_inertia_from_parameters

STEP = 1e-4
"""Of the central differences in s; second derivatives in s are of the size of the first."""

MOST_STEPS = 8
MOST_HALVINGS = 6
SMALL_STEP = 0.1
"""Gauss-Newton ends with a step below this many standard deviations."""


def physical_start(
    learn: Learned | Iterable[Learned],
    likelihood: MarginalLikelihood,
    noise: Mapping[str, Tensor],
    prior_strength: float = 0.0,
) -> tuple[PhysicalParameters, LatentKernels, list[dict[str, Tensor]]]:
    """Whitened parameters, and the parameters of the search at the values of the system and after every step.

    The last of these is where the search begins, with mean "zero" the only one; the kernels belong to it. `noise` holds
    the noise parameters at their start.
    Raises as `PhysicalParameters.of`, and FitError where the likelihood cannot be evaluated at the start values.
    """
    physical = PhysicalParameters.of(likelihood.system, learn)
    rows = _Rows(physical, likelihood, noise, _ridge(physical, prior_strength))
    try:
        with torch.no_grad():
            scaled = _gauss_newton(rows) if likelihood.mean == "analytical" else [physical.zero]
            lower = torch.linalg.cholesky(_information(rows, scaled[-1]))
    except (NumericalError, torch.linalg.LinAlgError) as error:
        raise FitError(f"the dynamics cannot be evaluated at the start values of `learn`: {error}") from None
    identity = torch.eye(len(lower), dtype=lower.dtype, device=lower.device)
    each = [rows.kernels(s) for s in scaled]
    path = [k.initial_parameters() | {PHYSICAL: lower.mT @ s} for k, s in zip(each, scaled, strict=True)]
    whitened = replace(physical, transform=torch.linalg.solve_triangular(lower.mT, identity, upper=True))
    return whitened, each[-1], path


@dataclass(frozen=True, eq=False)
class _Rows:
    """Residuals and covariances of the rows at s, as if rows were independent."""

    physical: PhysicalParameters
    likelihood: MarginalLikelihood
    noise: Mapping[str, Tensor]
    ridge: Float[Tensor, "k k"]  # G

    def kernels(self, s: Float[Tensor, "k"]) -> LatentKernels:
        """With variances from the moments of the residual at s."""
        return self.likelihood.kernels(self.physical.tensors(s))

    def accelerations(self, kernels: LatentKernels, s: Float[Tensor, "k"]) -> tuple[Tensor, Tensor]:
        """a - m (N, nv) and R + W k W^T (N, nv, nv)."""
        features, W, residual, R = self.likelihood.terms({**self.noise, **self.physical.tensors(s)})
        variances = [kernel.diagonal(z) for kernel, z in zip(kernels.dense, features, strict=True)]
        spread = torch.stack(variances, -1) if variances else W.new_zeros(len(W), 0)
        covariance = (W * spread[:, None, :]) @ W.mT + (torch.diag_embed(R) if R.dim() == 2 else R)
        return residual, covariance.expand(*residual.shape, residual.shape[-1])

    def forces(self, kernels: LatentKernels, s: Float[Tensor, "k"]) -> tuple[Tensor, Tensor]:
        """e (N, nv) and its covariance (N, nv, nv), with variances along the constraints that keep it regular."""
        residual, covariance = self.accelerations(kernels, s)
        dynamics = self.likelihood.dynamics(self.physical.tensors(s))
        identity = torch.eye(residual.shape[-1], dtype=residual.dtype, device=residual.device)
        across = torch.linalg.pinv(dynamics.A) @ dynamics.A if dynamics.A.shape[-2] else torch.zeros_like(dynamics.H)
        to_force = (identity - across) @ dynamics.M
        full = to_force @ covariance @ to_force.mT
        size = full.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
        return (to_force @ residual[..., None])[..., 0], full + size * across


def _ridge(physical: PhysicalParameters, prior_strength: float) -> Float[Tensor, "k k"]:
    """G: 1, and w times the metric tr(P^-1 dP P^-1 dP) of the pseudo-inertias at the start."""
    factors = {
        link: torch.linalg.cholesky(pseudo_inertia_from_parameters(value))
        for link, value in inertials_of(physical.tensors(physical.zero)).items()
    }

    def whitened(s: Tensor) -> Tensor:
        inertias = inertials_of(physical.tensors(s))
        return torch.stack([relative_inertia(value, factors[link]) for link, value in inertias.items()]).flatten()

    if not factors:  # coefficients alone
        return torch.eye(len(physical.zero), dtype=physical.zero.dtype, device=physical.zero.device)
    J = torch.as_tensor(torch.autograd.functional.jacobian(whitened, physical.zero))
    return torch.eye(J.shape[1], dtype=J.dtype, device=J.device) + prior_strength * J.mT @ J


def _slopes(function: Callable[[Tensor], tuple[Tensor, Tensor]], s: Float[Tensor, "k"]) -> tuple[Tensor, Tensor]:
    """Derivatives (k, ...) of a residual and its covariance with respect to s."""
    pairs = [
        [(high - low) / (2.0 * STEP) for high, low in zip(function(s + step), function(s - step), strict=True)]
        for step in STEP * torch.eye(len(s), dtype=s.dtype, device=s.device)
    ]
    return torch.stack([mean for mean, _ in pairs]), torch.stack([covariance for _, covariance in pairs])


def _information(rows: _Rows, s: Float[Tensor, "k"]) -> Float[Tensor, "k k"]:
    """F at s, with variances from the moments there."""
    function = partial(rows.accelerations, rows.kernels(s))
    whiten = partial(torch.linalg.solve_triangular, torch.linalg.cholesky(function(s)[1]), upper=False)
    d_mean, d_covariance = _slopes(function, s)
    J = whiten(d_mean[..., None]).flatten(1)
    S = whiten(whiten(d_covariance).mT).flatten(1)
    return rows.ridge + J @ J.mT + 0.5 * S @ S.mT


def _gauss_newton(rows: _Rows) -> list[Tensor]:
    """s at the start and after every step."""
    path = [rows.physical.zero]
    while len(path) <= MOST_STEPS:
        s = path[-1]
        function = partial(rows.forces, rows.kernels(s))
        residual, covariance = function(s)
        whiten = partial(torch.linalg.solve_triangular, torch.linalg.cholesky(covariance), upper=False)
        J = whiten(_slopes(function, s)[0][..., None]).flatten(1)
        lower = torch.linalg.cholesky(rows.ridge + J @ J.mT)
        gradient = J @ whiten(residual[..., None]).flatten() + rows.ridge @ s
        step = -torch.cholesky_solve(gradient[:, None], lower)[:, 0]

        def squares(at: Tensor, function=function, whiten=whiten) -> float:
            try:
                return float(whiten(function(at)[0][..., None]).square().sum() + at @ rows.ridge @ at)
            except NumericalError:
                return float("inf")

        before = squares(s)
        tried = (s + 0.5**halving * step for halving in range(MOST_HALVINGS))
        better = next((point for point in tried if squares(point) < before), None)  # false for NaN
        if better is None or float(torch.linalg.vector_norm(lower.mT @ step)) < SMALL_STEP:
            break
        path.append(better)
    return path
