"""A kernel that learns where a force changes abruptly: a squared exponential on features and on outputs of a network.

Source: Wilson et al., "Deep kernel learning", AISTATS (2016). Ober et al., "The promises and pitfalls of deep kernel
learning", UAI (2021), show that such kernels overfit: two hidden layers of eight units with normal priors on their
weights did so here, too (`python -m benchmarks.kernels` has the numbers of what is left). So the network has one layer
of few, steep units, and each has to earn its parameters against a sparse prior.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import torch
from gpytorch.kernels import Kernel, ScaleKernel
from gpytorch.priors import NormalPrior, Prior
from gpytorch.priors.utils import _bufferize_attributes
from torch import Tensor
from torch.distributions import StudentT
from typing_extensions import override

from forcegp.priors.basic_kernels import (
    LOG_LENGTHSCALE_SPREAD,
    float64,
    log_scale,
    register_log_normal_prior,
    typical_lengthscale,
)

UNITS = 2
"""Places of abrupt change."""

STEEPNESS = 4.0
"""Of the units, per standardised feature: a change takes about half a standard deviation of the features."""

STEEPNESS_LOG_SPREAD = 0.3

CHANGE = 0.5
"""Start value of the change that a unit makes: exp(-1/2 (2 CHANGE)^2) = 0.61 of the correlation across is left."""

SPARSE_SCALE = 0.01
COST_PER_PARAMETER = 0.3
"""The prior on a change a is (1 + a^2 / SPARSE_SCALE^2)^-(COST_PER_PARAMETER parameters of the unit): a change of 0.6
costs 2.5 nats for every parameter, about what the Bayesian information criterion asks for at 100 points.
"""

SEED = 20160509
"""Of the places where the units begin, which are the same for every kernel of a dimension."""


def deep(dimension: int, variance: float | Tensor) -> ScaleKernel:
    """variance times `NetworkKernel`: like the squared exponential, with abrupt changes where the data ask for them."""
    kernel = ScaleKernel(NetworkKernel(dimension), outputscale_constraint=log_scale()).double()
    kernel.outputscale = float64(variance)
    return kernel


class NetworkKernel(Kernel):
    """k = exp(-1/2 |e(z) - e(z')|^2) with e(z) = [z / l, h(z)] and units h_k = a_k tanh(4 (w_k . z + b_k)).

    Where a_k = 0 this is the squared exponential with length scales l. Else the plane w_k . z + b_k = 0 divides the
    space of features, and values on its two sides have less in common. Priors: l as for the squared exponential;
    log |w_k| ~ N(0, 0.3^2), since slow units would learn what smooth functions of all features are and be too sure of
    it; b_k ~ N(0, 1); a Student t distribution of small scale for a_k, which makes a unit that is not needed vanish.

    Parameters: raw_lengthscale (1, dimension), slope (2, dimension), bias (2,), change (2,).
    """

    has_lengthscale = True

    def __init__(self, dimension: int) -> None:
        super().__init__(ard_num_dims=dimension, lengthscale_constraint=log_scale())
        self.double()
        self.lengthscale = float64(math.sqrt(dimension)).expand(1, dimension)
        register_log_normal_prior(self, "lengthscale", typical_lengthscale(dimension), LOG_LENGTHSCALE_SPREAD)
        random = torch.randn(UNITS, dimension + 1, generator=torch.Generator().manual_seed(SEED), dtype=torch.float64)
        directions = torch.nn.functional.normalize(random[:, :-1], dim=-1)
        self.slope = torch.nn.Parameter(directions)
        self.bias = torch.nn.Parameter(random[:, -1].clone())
        self.change = torch.nn.Parameter(torch.full((UNITS,), CHANGE, dtype=torch.float64))
        zero, one = float64(0.0), float64(1.0)
        self.register_prior("slope_prior", NormalPrior(zero, STEEPNESS_LOG_SPREAD * one), _log_steepness)
        self.register_prior("bias_prior", NormalPrior(zero, one), partial(_parameter, "bias"))
        degrees = 2.0 * COST_PER_PARAMETER * (dimension + 2) - 1.0
        sparse = StudentTPrior(degrees * one, zero, SPARSE_SCALE / math.sqrt(degrees) * one)
        self.register_prior("change_prior", sparse, partial(_parameter, "change"))

    def units(self, z: Tensor) -> Tensor:
        """h(z) (n, 2)."""
        return self.change * torch.tanh(STEEPNESS * (z @ self.slope.mT + self.bias))

    def squared_exponential_embedding(self, z: Tensor) -> Tensor:
        """e(z) (n, dimension + 2), in which the kernel is the squared exponential of length scale 1."""
        return torch.cat([z / self.lengthscale, self.units(z)], dim=-1)

    @override
    def forward(
        self, x1: Tensor, x2: Tensor, diag: bool = False, last_dim_is_batch: bool = False, **params: Any
    ) -> Tensor:
        left, right = self.squared_exponential_embedding(x1), self.squared_exponential_embedding(x2)
        difference = left - right if diag else left[..., :, None, :] - right[..., None, :, :]
        return torch.exp(-0.5 * difference.square().sum(-1))


class StudentTPrior(Prior, StudentT):  # type: ignore[misc]  # the bases name the argument of log_prob differently
    """A Student t distribution as a GPyTorch prior; df, loc and scale are tensors."""

    def __init__(self, df: Tensor, loc: Tensor, scale: Tensor) -> None:
        torch.nn.Module.__init__(self)
        StudentT.__init__(self, df, loc, scale, validate_args=False)
        _bufferize_attributes(self, ("df", "loc", "scale"))
        self._transform = None


def _parameter(name: str, kernel: NetworkKernel) -> Tensor:
    return getattr(kernel, name)


def _log_steepness(kernel: NetworkKernel) -> Tensor:
    return torch.linalg.vector_norm(kernel.slope, dim=-1).log()
