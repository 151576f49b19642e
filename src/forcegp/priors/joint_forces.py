"""Priors on forces or accelerations at every joint as functions of the whole state, and no forces at all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, usable_arguments
from forcegp.mechanics import ConstrainedDynamics
from forcegp.priors.force_prior import ExpressedKernels, ForcePrior
from forcegp.priors.kernels import check_kernel
from forcegp.robots import Robot

UNITS = {"q": ("rad", "m"), "v": ("rad/s", "m/s"), "a": ("rad/s^2", "m/s^2"), "u": ("Nm", "N")}
"""Of positions, velocities, accelerations and forces, for joints that turn and joints that slide."""


def joint_units(quantity: str, joints: Sequence[str], robot: Robot) -> tuple[str, ...]:
    """The unit that a key of `UNITS` has at each of the joints."""
    turning, sliding = UNITS[quantity]
    slides = {joint.name for joint in robot.joints if joint.type == "prismatic"}
    return tuple(sliding if name in slides else turning for name in joints)


def joint_labels(what: str, quantity: str, joints: Sequence[str], robot: Robot) -> tuple[str, ...]:
    """`what` of every joint with its unit, for example "velocity of joint_1 [rad/s]"."""
    units = joint_units(quantity, joints, robot)
    return tuple(f"{what} of {name} [{unit}]" for name, unit in zip(joints, units, strict=True))


INPUTS = ("q", "v", "u")
ANGLES = ("plain", "sin-cos")


@dataclass(frozen=True)
class JointForces(ExpressedKernels):
    """Q_U = f(x) with independent f_j ~ GP(0, k_j), one per joint (Rath et al. 2021, eqs. 5-7).

    `inputs` chooses which of q, v and u the force may depend on. With `angles="sin-cos"` the position of every joint
    that turns enters as its sine and cosine, so that a full turn changes nothing and +pi is beside -pi. `kernel` is an
    expression of `forcegp.priors.kernel_of`; the default has one length scale per feature.
    """

    inputs: tuple[str, ...] = INPUTS
    kernel: str = "squared-exponential"
    angles: str = "plain"

    @usable_arguments("JointForces")
    def __post_init__(self) -> None:
        object.__setattr__(self, "inputs", chosen_inputs(type(self).__name__, self.inputs, INPUTS))
        check_kernel(self.kernel)
        if self.angles not in ANGLES:
            raise InvalidInput(f"{type(self).__name__} angles is {self.angles!r}; give 'plain' or 'sin-cos'.")

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return robot.joint_names

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        u = dynamics.state.u
        return torch.eye(u.shape[-1], dtype=u.dtype, device=u.device).expand_as(dynamics.H)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        state = dynamics.state
        columns = {"q": state.q, "v": state.v, "u": state.u}
        if self.angles == "sin-cos":
            turns = _turns(state.robot)
            q = state.q
            columns["q"] = torch.cat([q[..., ~turns], q[..., turns].sin(), q[..., turns].cos()], dim=-1)
        z = torch.cat([columns[name] for name in self.inputs], dim=-1)
        return (z,) * state.u.shape[-1]

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        joints = robot.joint_names
        named = {name: joint_labels(name, name, joints, robot) for name in INPUTS}
        if self.angles == "sin-cos":
            turns = _turns(robot).tolist()
            turning = [joint for joint, turn in zip(joints, turns, strict=True) if turn]
            sliding = [label for label, turn in zip(named["q"], turns, strict=True) if not turn]
            waves = [f"{wave} q of {joint}" for wave in ("sin", "cos") for joint in turning]
            named["q"] = (*sliding, *waves)
        return (tuple(entry for name in self.inputs for entry in named[name]),) * robot.nv

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return joint_units("u", robot.joint_names, robot)


def chosen_inputs(prior: str, given: object, allowed: tuple[str, ...]) -> tuple[str, ...]:
    """`given` as a tuple of names from `allowed`, each once. Raises InvalidInput for anything else."""
    inputs = as_names(given)
    if not inputs or any(name not in allowed for name in inputs) or len(set(inputs)) < len(inputs):
        names = ", ".join(map(repr, allowed))
        raise InvalidInput(f"{prior} inputs are {given!r}; give one or more of {names}, each once.")
    return inputs


def as_names(given: object) -> tuple[Any, ...]:
    """One name, or several, as a tuple; empty for what is neither."""
    if isinstance(given, str):
        return (given,)
    return tuple(given) if isinstance(given, Iterable) else ()


def _turns(robot: Robot) -> Tensor:
    return torch.tensor([joint.type != "prismatic" for joint in robot.joints], device=robot.device)


@dataclass(frozen=True)
class JointAccelerations(JointForces):
    """Q_U = M f(x): the processes f_j are the acceleration (rad/s^2, m/s^2) that an unconstrained robot would have.

    Then H M f = f - M^-1 A^T (A M^-1 A^T)^+ A f, the projection of f onto what the constraint allows (Geist & Trimpe
    2020, "Learning constrained dynamics with Gauss' principle adhering Gaussian processes", the S-GP [38] of Rath et
    al. 2021). With the mean "zero" the processes carry gravity and actuation, too. Without contacts H M is the
    identity, and this is an independent Gaussian process per joint.
    """

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return dynamics.M

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return joint_units("a", robot.joint_names, robot)


@dataclass(frozen=True)
class NoForces(ForcePrior):
    """Q_U = 0: no latent function at all, so a = M^-1 Q_b + H Q_K + noise (Rath et al. 2021, eq. 4 with Q_z = 0).

    What can be fitted are learned noise and physical parameters, by maximum likelihood.
    """

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return ()

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return dynamics.H[..., :0]

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        return ()

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        return ()

    @override
    def kernels(self, robot: Robot, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        return ()
