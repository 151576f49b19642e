"""`JointFriction`: one friction curve per joint, a function of that joint's velocity alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, UnknownJoint, unknown_name_message
from forcegp.mechanics import ConstrainedDynamics, MechanicalSystem
from forcegp.priors.expressed_kernels import ExpressedKernels
from forcegp.priors.force_prior import Scaling
from forcegp.priors.joint_forces import as_names
from forcegp.priors.joint_units import joint_labels, joint_units
from forcegp.priors.kernels import check_kernel
from forcegp.robots import Robot


@dataclass(frozen=True)
class JointFriction(ExpressedKernels):
    """Q_U,j = -f_j(v_j): what resists joint j, positive for positive velocity, an independent function per joint.

    The kernel "friction" gives f_j(v) = tanh(v / w) g(v) + d v with a learned velocity scale w and an unknown level g
    (`priors/friction_kernel.py`): Coulomb, Stribeck and viscous friction, zero at rest, and different in the two
    directions if the data say so (Armstrong-Helouvry, Dupont & Canudas de Wit 1994 list these parts). Velocities are
    only scaled, never shifted, so that zero stays zero. `joints` restricts the prior to some joints, by name.
    """

    # This constructor is the check, with messages for people; run-time checks of annotations must not come before it.
    __no_type_check__: ClassVar[bool] = True

    joints: tuple[str, ...] | None = None
    kernel: str = "friction"

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", chosen_joints(type(self).__name__, self.joints))
        check_kernel(self.kernel)

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return robot.joint_names if self.joints is None else self.joints

    @override
    def check(self, system: MechanicalSystem) -> None:
        joint_indices(self.joints, system.robot)

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return -joint_columns(self.joints, dynamics)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        v = dynamics.state.v
        return tuple(v[..., index, None] for index in joint_indices(self.joints, dynamics.state.kinematics.robot))

    @override
    def scalings(self, robot: Robot) -> tuple[Scaling, ...]:
        return ("scale",) * len(self.latent_names(robot))

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        return tuple((label,) for label in joint_labels("velocity", "v", self.latent_names(robot), robot))

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


def joint_columns(joints: Sequence[str] | None, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
    """B with one column e_j for each of the joints."""
    H = dynamics.H
    columns = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
    columns = columns[:, joint_indices(joints, dynamics.state.kinematics.robot)]
    return columns.expand(*H.shape[:-2], *columns.shape)
