"""Priors with a function of its own for every joint: friction, and forces that repeat along the position."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

import torch
from gpytorch.constraints import Positive
from gpytorch.kernels import Kernel, PeriodicKernel, ScaleKernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, UnknownJoint, unknown_name_message
from forcegp.mechanics import ConstrainedDynamics, MechanicalSystem
from forcegp.priors.basic_kernels import LOG_LENGTHSCALE_SPREAD, log_scale, register_log_normal_prior
from forcegp.priors.force_prior import ExpressedKernels, ForcePrior, Scaling
from forcegp.priors.joint_forces import as_names, joint_labels, joint_units
from forcegp.priors.kernels import check_kernel
from forcegp.robots import Robot


class PerJointPrior(ForcePrior):
    """Q_U,j = f_j(x_j), or minus that, in Nm or N: an independent function per joint, of its own position or velocity.

    A subclass is a dataclass with the field `joints` (names as `chosen_joints` gives them, None: all), and defines by
    `depends_on` what x_j is: "q" or "v".
    """

    joints: Any  # names of joints, or None, of which every subclass names its own default
    depends_on: ClassVar[Literal["q", "v"]]

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return robot.joint_names if self.joints is None else self.joints

    @override
    def check(self, system: MechanicalSystem) -> None:
        joint_indices(self.joints, system.robot)

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        H = dynamics.H
        columns = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
        columns = columns[:, joint_indices(self.joints, dynamics.state.robot)]
        return columns.expand(*H.shape[:-2], *columns.shape)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        state = dynamics.state
        x = {"q": state.q, "v": state.v}[self.depends_on]
        return tuple(x[..., index, None] for index in joint_indices(self.joints, state.robot))

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        what = {"q": "position", "v": "velocity"}[self.depends_on]
        return tuple((label,) for label in joint_labels(what, self.depends_on, self.latent_names(robot), robot))

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return joint_units("u", self.latent_names(robot), robot)


def chosen_joints(prior: str, given: object) -> tuple[str, ...] | None:
    """Names of joints as a tuple; None stands for all. Raises InvalidInput for what is no list of different names."""
    if given is None:
        return None
    names = as_names(given)
    if not names or any(not isinstance(name, str) for name in names) or len(set(names)) < len(names):
        raise InvalidInput(f"{prior} joints are {given!r}; give names of joints, each once, or None for all.")
    return names


def joint_indices(joints: Sequence[str] | None, robot: Robot) -> list[int]:
    """Positions of the joints (None: all). Raises UnknownJoint for a name that the robot does not have."""
    names = robot.joint_names
    for joint in joints or ():
        if joint not in names:
            raise UnknownJoint(unknown_name_message("joint", joint, robot.name, names))
    return list(range(len(names))) if joints is None else [names.index(joint) for joint in joints]


@dataclass(frozen=True)
class JointFriction(PerJointPrior, ExpressedKernels):
    """Q_U,j = -f_j(v_j): what resists joint j, positive for positive velocity, an independent function per joint.

    The kernel "friction" gives f_j(v) = tanh(v / w) g(v) + d v with a learned velocity scale w and an unknown level g
    (`priors/friction_kernel.py`): Coulomb, Stribeck and viscous friction, zero at rest, and different in the two
    directions if the data show it (Armstrong-Helouvry, Dupont & Canudas de Wit 1994 list these parts). Velocities are
    only scaled, never shifted, so that zero stays zero. `joints` restricts the prior to some joints, by name.
    """

    depends_on: ClassVar[Literal["q", "v"]] = "v"

    joints: tuple[str, ...] | None = None
    kernel: str = "friction"

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", chosen_joints(type(self).__name__, self.joints))
        check_kernel(self.kernel)

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return -super().mixing(dynamics)

    @override
    def scalings(self, robot: Robot) -> tuple[Scaling, ...]:
        return ("scale",) * len(self.latent_names(robot))


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
