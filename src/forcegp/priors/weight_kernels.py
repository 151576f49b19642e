"""Kernels of functions with finitely many unknown weights: a constant, a linear function, friction of a joint."""

from __future__ import annotations

from typing import Any, cast

import torch
from gpytorch.constraints import Interval
from gpytorch.kernels import AdditiveKernel, ConstantKernel, Kernel, LinearKernel, ProductKernel
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.priors.kernel_parameters import LOG_VARIANCE_SPREAD, float64, log_scale, register_log_normal_prior
from forcegp.priors.stationary_kernels import squared_exponential_kernel

WIDTH = 0.1
"""Start value of the velocity at which dry friction is developed, as a fraction of the rms velocity."""

WIDTH_LOG_SPREAD = 1.0

STRIBECK_LENGTHSCALE = 0.5
"""Start value of the length scale of what velocity does to dry friction, as a fraction of the rms velocity."""


def linear(dimension: int, variance: float | Tensor) -> LinearKernel:
    """k = sum_d s_d z_d z'_d: a linear function through zero whose weights have variances s_d (GPyTorch: `variance`).

    They start at variance / dimension, so that standardised features give `variance` together, each with the prior
    log s_d ~ N(log of its start value, 2^2).
    """
    kernel = LinearKernel(ard_num_dims=dimension, variance_constraint=log_scale()).double()
    start = float64(variance) / dimension
    kernel.variance = start.expand(1, dimension)
    register_log_normal_prior(kernel, "variance", start, LOG_VARIANCE_SPREAD)
    return kernel


def constant(dimension: int, variance: float | Tensor) -> ConstantKernel:
    """k = c: one unknown number of variance c, which starts at `variance`, log c ~ N(log variance, 2^2)."""
    kernel = ConstantKernel(constant_constraint=log_scale()).double()
    kernel.constant = float64(variance)
    register_log_normal_prior(kernel, "constant", variance, LOG_VARIANCE_SPREAD)
    return kernel


def friction(dimension: int, variance: float | Tensor) -> AdditiveKernel:
    """Friction as a function f(s) = phi(s) g(s) + d s of one velocity s, divided by its rms and not shifted.

    phi(s) = tanh(s / w) is zero at rest; g = c + h(s) is the level of dry friction, a constant (Coulomb) and a smooth
    function of velocity (Stribeck's dip, and a difference between the two directions); d is viscous:

        k = tanh(s / w) tanh(s' / w) (c^2 + r^2 exp(-(s - s')^2 / (2 l^2))) + d^2 s s'

    Each of the three shares gets a third of `variance` at the start. w starts at 0.1 with log w ~ N(log 0.1, 1); l at
    0.5 with the prior of the squared exponential, wide and towards long.
    Source of the law: Olsson et al., "Friction models and friction compensation", Eur. J. Control (1998), section 2.
    """
    if dimension != 1:
        raise InvalidInput(
            f"the kernel 'friction' is a function of one velocity and was given {dimension} features; give it a latent "
            "with one feature"
        )
    share = float64(variance) / 3.0
    level = AdditiveKernel(constant(1, share), squared_exponential_kernel(1, STRIBECK_LENGTHSCALE, share))
    return AdditiveKernel(ProductKernel(SmoothSignKernel(), level), linear(1, share))


class SmoothSignKernel(Kernel):
    """k = tanh(s / w) tanh(s' / w) of one feature s: a function that is a multiple of a smoothed sign of s.

    Parameter `width` (1, 1), in units of the feature: positive, on a log scale, log w ~ N(log 0.1, 1) at the start.
    """

    def __init__(self, width: float = WIDTH) -> None:
        super().__init__()
        self.register_parameter("raw_width", torch.nn.Parameter(float64(width).log().reshape(1, 1)))
        self.register_constraint("raw_width", log_scale())
        register_log_normal_prior(self, "width", width, WIDTH_LOG_SPREAD)

    @property
    def width(self) -> Tensor:
        """The velocity, over its rms, at which tanh(1) = 76 % of the friction is developed."""
        constraint = self.raw_width_constraint
        assert isinstance(constraint, Interval)
        return constraint.transform(cast(Tensor, self.raw_width))

    def weight_features(self, z: Tensor) -> Tensor:
        """phi (n, 1), with k = phi phi^T."""
        return torch.tanh(z / self.width)

    @override
    def forward(
        self, x1: Tensor, x2: Tensor, diag: bool = False, last_dim_is_batch: bool = False, **params: Any
    ) -> Tensor:
        left, right = self.weight_features(x1), self.weight_features(x2)
        return (left * right).sum(-1) if diag else left @ right.mT
