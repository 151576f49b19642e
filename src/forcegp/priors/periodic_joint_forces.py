"""`PeriodicJointForces`: cogging of motors and ripple of gears, a force per joint that repeats along its position."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import torch
from gpytorch.constraints import Positive
from gpytorch.kernels import Kernel, PeriodicKernel, ScaleKernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.priors.force_prior import Scaling
from forcegp.priors.kernel_parameters import log_scale, register_log_normal_prior
from forcegp.priors.per_joint import PerJointPrior, chosen_joints
from forcegp.priors.stationary_kernels import LOG_LENGTHSCALE_SPREAD
from forcegp.robots import Robot

PERIOD_SPREAD = 0.02
"""Standard deviation of the prior on the logarithm of a period: likelihoods of periods have many narrow optima."""


@dataclass(frozen=True)
class PeriodicJointForces(PerJointPrior):
    """Q_U,j = f_j(q_j) with f_j of period `period` (rad, or m for joints that slide), one independent function each.

    The kernel is s exp(-2 sin^2(pi (q - q') / period) / l) (MacKay 1998; Rasmussen & Williams 2006, eq. 4.31, with l
    the square of their length scale). The period is fitted too, near the value given: a motor with 12 pole pairs has
    2 pi / 12, behind a gear of ratio 100 it is 2 pi / 1200. `joints` restricts the prior to some joints, by name.
    """

    depends_on: ClassVar[Literal["q", "v"]] = "q"

    period: float = 2.0 * math.pi
    joints: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", chosen_joints(type(self).__name__, self.joints))
        if not isinstance(self.period, int | float) or not 0.0 < self.period < math.inf:
            raise InvalidInput(f"PeriodicJointForces period is {self.period!r}; give a positive number in rad (or m).")
        object.__setattr__(self, "period", float(self.period))

    @override
    def scalings(self, robot: Robot) -> tuple[Scaling, ...]:
        return ("none",) * len(self.latent_names(robot))  # the period is in rad

    @override
    def kernels(self, robot: Robot, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        return tuple(self._kernel(variance) for variance in variances)

    def _kernel(self, variance: Tensor) -> Kernel:
        near = Positive(partial(_period, self.period), partial(_spreads, self.period))  # type: ignore[arg-type]  # stubs
        base = PeriodicKernel(lengthscale_constraint=log_scale(), period_length_constraint=near)
        kernel = ScaleKernel(base, outputscale_constraint=log_scale()).double()
        register_log_normal_prior(base, "period_length", self.period, PERIOD_SPREAD)
        # a joint without ripple would run off to a constant of boundless variance
        register_log_normal_prior(base, "lengthscale", 1.0, LOG_LENGTHSCALE_SPREAD)
        base.period_length = torch.tensor(self.period, dtype=torch.float64)
        base.lengthscale = torch.tensor(1.0, dtype=torch.float64)
        kernel.outputscale = variance
        return kernel


def _period(given: float, spreads: Tensor) -> Tensor:
    """A period that is searched in standard deviations of its prior, so that restarts begin near the one given, too."""
    return given * (PERIOD_SPREAD * spreads).exp()


def _spreads(given: float, period: Tensor) -> Tensor:
    return (period / given).log() / PERIOD_SPREAD
