"""What a fit lowers: the negative log marginal likelihood, less the log densities of the priors on its parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass

import torch
from gpytorch.kernels import ScaleKernel
from gpytorch.priors import NormalPrior
from jaxtyping import Float
from torch import Tensor

from forcegp.inference import LatentKernels
from forcegp.models.identification.physical_parameters import PHYSICAL, PhysicalParameters, inertials_of
from forcegp.models.noise import Noise
from forcegp.models.structured.marginal_likelihood import MarginalLikelihood
from forcegp.robots import pseudo_inertia_from_parameters

LOG_VARIANCE_SPREAD = 2.0
"""Standard deviation of the prior on the logarithm of a latent's variance, where physical parameters are learned."""


@dataclass(frozen=True, eq=False)
class FitObjective:
    """The objective as a function of the free parameters alone; a class so that processes can receive it.

    With `hyperprior` kernels (see also `with_variance_priors`) and learned noise have their priors; `prior_strength` is
    the weight of the learned inertias' distance from where they start. With inducing `points` the bound through them
    stands for the likelihood.
    """

    likelihood: MarginalLikelihood
    kernels: LatentKernels
    noise: Noise
    fixed: Mapping[str, Tensor]
    hyperprior: bool
    physical: PhysicalParameters | None = None
    prior_strength: float = 0.0
    points: Sequence[Tensor] | None = None

    def __call__(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """In nats; differentiable once in every parameter."""
        named = {**self.fixed, **parameters}
        penalty = torch.zeros((), dtype=torch.float64)
        if self.physical is not None:
            named |= self.physical.tensors(named.pop(PHYSICAL))
            if self.prior_strength:
                start = inertials_of(self.physical.tensors(self.physical.zero))
                distances = [squared_distance(value, start[link]) for link, value in inertials_of(named).items()]
                penalty = 0.5 * self.prior_strength * sum(distances, penalty)
        if self.points is None:
            value = self.likelihood(self.kernels, named) + penalty
        else:
            value = self.likelihood.bound(self.kernels, named, self.points) + penalty
        return value - self.log_prior(parameters)

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """Log density of the hyper-parameters' priors; 0 without `hyperprior`."""
        if not self.hyperprior:
            return torch.zeros((), dtype=torch.float64)
        return self.kernels.log_prior(parameters) + self.noise.log_prior(parameters, self.likelihood.system.robot.nv)


def with_variance_priors(kernels: LatentKernels) -> LatentKernels:
    """A copy of which every output scale (variance) carries the prior log variance ~ N(log of its present value, 2^2).

    For fits that learn physical parameters, whose present values come from moments of the residual. The likelihood is
    flat below the noise: there a variance can run off to zero, the curvature takes the force for known to be zero, and
    standard errors of what competes with it are too small. Shared kernels count once; priors that a kernel brought
    along stay.
    """
    out = deepcopy(kernels)
    for module in out.modules():
        if isinstance(module, ScaleKernel) and "outputscale_prior" not in [name for name, *_ in module.named_priors()]:
            center = _log_variance(module).detach()
            prior = NormalPrior(center, torch.full_like(center, LOG_VARIANCE_SPREAD))
            module.register_prior("outputscale_prior", prior, _log_variance)
    return out


def _log_variance(kernel: ScaleKernel) -> Tensor:
    return torch.as_tensor(kernel.outputscale).log()


def squared_distance(parameters: Float[Tensor, "10"], reference: Float[Tensor, "10"]) -> Float[Tensor, ""]:
    """Squared affine-invariant distance of two pseudo-inertias P and P0, given as log-Cholesky parameters.

    d^2 = |log(P0^-1/2 P P0^-1/2)|_F^2 = sum_i log^2 lambda_i with the eigenvalues of P0^-1 P (Lee, Wensing & Park,
    "Geometric robot dynamic identification: a convex programming approach", T-RO 2020). It is the same in every frame
    and unit: a body of twice the mass and inertia is 2 log 2 away, wherever it is.
    """
    lower = torch.linalg.cholesky(pseudo_inertia_from_parameters(reference))
    half = torch.linalg.solve_triangular(lower, pseudo_inertia_from_parameters(parameters), upper=False)
    whitened = torch.linalg.solve_triangular(lower, half.mT, upper=False)
    return torch.linalg.eigvalsh(0.5 * (whitened + whitened.mT)).log().square().sum()
