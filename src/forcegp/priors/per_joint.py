"""What priors share that put a function of its own on every joint: which joints, and what it depends on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, UnknownJoint, unknown_name_message
from forcegp.mechanics import ConstrainedDynamics, MechanicalSystem
from forcegp.priors.force_prior import ForcePrior
from forcegp.priors.joint_forces import as_names
from forcegp.priors.joint_units import joint_labels, joint_units
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
