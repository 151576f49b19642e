"""The kernel of a friction curve: what resists the motion of one joint, or of one point on a surface."""

from __future__ import annotations

from typing import Any

import torch
from gpytorch.constraints import Interval
from gpytorch.kernels import AdditiveKernel, Kernel, ProductKernel, ScaleKernel
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.priors.basic_kernels import (
    LOG_VARIANCE_SPREAD,
    constant,
    float64,
    linear,
    log_scale,
    register_log_normal_prior,
)

WIDTH = 0.1
"""Start value of the velocity at which dry friction is developed, as a fraction of the rms velocity."""

WIDTH_LOG_SPREAD = 1.0


def friction(dimension: int, variance: float | Tensor) -> AdditiveKernel:
    """Friction as a function f(s) = phi(s) g(s) + d s of one velocity s, divided by its rms and not shifted.

    phi(s) = tanh(s / w) is zero at rest; g = c + h(s) is the level of dry friction, a constant (Coulomb) and a function
    of velocity (Stribeck's dip, and a difference between the two directions); d is viscous:

        k = tanh(s / w) tanh(s' / w) (c^2 + r^2 exp(-|x(s) - x(s')| / l)) + d^2 s s',   x(s) = asinh(s / w')

    x counts velocity by factors, like the logarithm, but passes through zero: dry friction changes within a small
    velocity near rest, and little beyond. Each of the three shares gets a third of `variance` at the start; w and w'
    start at 0.1, l at 1; all have log-normal priors about their start values, of a spread of 1, variances of 2. h is
    rough (Matern 1/2): smoother ones are as good where a law bends slowly, and fail where it bends within a few cm/s
    (docs/forces.md).
    Source of the law: Olsson et al., "Friction models and friction compensation", Eur. J. Control (1998), section 2.
    """
    if dimension != 1:
        raise InvalidInput(
            f"the kernel 'friction' is a function of one velocity and was given {dimension} features; give it a latent "
            "with one feature"
        )
    share = float64(variance) / 3.0
    change = ScaleKernel(LogVelocityKernel(), outputscale_constraint=log_scale()).double()
    change.outputscale = share
    register_log_normal_prior(change, "outputscale", share, LOG_VARIANCE_SPREAD)
    level = AdditiveKernel(constant(1, share), change)
    return AdditiveKernel(ProductKernel(SmoothSignKernel(), level), linear(1, share))


class _WidthKernel(Kernel):
    """A kernel with a velocity `width` (1, 1) in units of the feature; log w ~ N(log of its start value, 1)."""

    def __init__(self, width: float, **more: Any) -> None:
        super().__init__(**more)
        self.register_parameter("raw_width", torch.nn.Parameter(float64(width).log().reshape(1, 1)))
        self.register_constraint("raw_width", log_scale())
        register_log_normal_prior(self, "width", width, WIDTH_LOG_SPREAD)

    @property
    def width(self) -> Tensor:
        """As a positive number."""
        constraint, raw = self.raw_width_constraint, self.raw_width
        assert isinstance(constraint, Interval)
        assert isinstance(raw, Tensor)
        return constraint.transform(raw)


class SmoothSignKernel(_WidthKernel):
    """k = tanh(s / w) tanh(s' / w) of one feature s: a function that is a multiple of a smoothed sign of s.

    At s = w, 76 % of the friction is developed.
    """

    def __init__(self, width: float = WIDTH) -> None:
        super().__init__(width)

    def weight_features(self, z: Tensor) -> Tensor:
        """phi (n, 1), with k = phi phi^T."""
        return torch.tanh(z / self.width)

    @override
    def forward(
        self, x1: Tensor, x2: Tensor, diag: bool = False, last_dim_is_batch: bool = False, **params: Any
    ) -> Tensor:
        left, right = self.weight_features(x1), self.weight_features(x2)
        return (left * right).sum(-1) if diag else left @ right.mT


class LogVelocityKernel(_WidthKernel):
    """k = exp(-|x - x'| / l), x = asinh(s / w) of one feature s: the same change for every factor in velocity.

    The Ornstein-Uhlenbeck process (Matern 1/2; Rasmussen & Williams 2006, eq. 4.18) of a velocity on a logarithmic
    scale that is linear within w. l starts at 1, a factor of e.
    """

    has_lengthscale = True
    nu = 0.5

    def __init__(self, width: float = WIDTH) -> None:
        super().__init__(width, ard_num_dims=1, lengthscale_constraint=log_scale())
        self.double()
        self.lengthscale = float64(1.0).expand(1, 1)
        register_log_normal_prior(self, "lengthscale", 1.0, 1.0)

    def matern_embedding(self, z: Tensor) -> Tensor:
        """x / l (n, 1), in which the kernel is a Matern of smoothness `nu` and length scale 1."""
        return torch.asinh(z / self.width) / self.lengthscale

    @override
    def forward(
        self, x1: Tensor, x2: Tensor, diag: bool = False, last_dim_is_batch: bool = False, **params: Any
    ) -> Tensor:
        left, right = self.matern_embedding(x1), self.matern_embedding(x2)
        difference = left - right if diag else left[..., :, None, :] - right[..., None, :, :]
        return torch.exp(-difference.abs().sum(-1))
