"""The point at which a prior's forces act: where it is, how it moves, and along which axes its forces are counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.mechanics import ConstrainedDynamics, MechanicalSystem, surface_axes
from forcegp.robots import Robot

AXES = ("world", "tool", "surface")


@dataclass(frozen=True, eq=False)
class ToolPoint:
    """A point fixed in a link: world position [m], Jacobian (linear; angular) and orientation of the link's axes."""

    position: Float[Tensor, "*batch 3"]
    jacobian: Float[Tensor, "*batch 6 nv"]
    orientation: Float[Tensor, "*batch 3 3"]

    @classmethod
    def of(cls, dynamics: ConstrainedDynamics, frame: str, point: Sequence[float]) -> ToolPoint:
        """At every state of the dynamics. Raises UnknownFrame."""
        kinematics = dynamics.state.kinematics
        pose = kinematics.frame_pose(frame)
        local = torch.tensor(point, dtype=pose.dtype, device=pose.device)
        position = pose[..., :3, :3] @ local + pose[..., :3, 3]
        return cls(position, kinematics.frame_jacobian(frame, tuple(point)), pose[..., :3, :3])

    @classmethod
    def of_contact(cls, dynamics: ConstrainedDynamics, contact: int) -> ToolPoint:
        """The point that touches."""
        touching = dynamics.contacts[contact]
        return cls.of(dynamics, touching.frame, touching.point)

    def velocity(self, v: Float[Tensor, "*batch nv"]) -> Float[Tensor, "*batch 6"]:
        """Linear [m/s] and angular velocity [rad/s] in world axes."""
        return (self.jacobian @ v[..., None])[..., 0]


def has_contact(dynamics: ConstrainedDynamics, contact: int) -> bool:
    """Whether the constraint has that contact; forces of a contact that is not there are zero."""
    return contact < len(dynamics.contacts)


def contact_axes(dynamics: ConstrainedDynamics, contact: int) -> Float[Tensor, "*batch 3 3"]:
    """Tangents t1, t2 and normal n of a contact's surface, as columns in world axes."""
    return surface_axes(dynamics.normals[..., contact, :])


def nominal_normal_force(dynamics: ConstrainedDynamics, contact: int) -> Float[Tensor, "*batch"]:
    """|normal force| in N that the contact would have if the known forces were all: |s_p| |lambda(Q_U = 0)|."""
    size = torch.linalg.vector_norm(dynamics.normals[..., contact, :], dim=-1)
    return size * dynamics.multiplier_map().offset[..., contact].abs()


def is_contact_number(value: object) -> bool:
    """Whether it can be the number of a contact, counted from 0."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def require_contact(prior: str, contact: int, system: MechanicalSystem) -> None:
    """Raise InvalidInput if the system has no such contact."""
    if contact >= len(system.contacts):
        numbers = ", ".join(map(str, range(len(system.contacts))))
        have = f"only contact {numbers}" if system.contacts else "no contact"
        raise InvalidInput(
            f"{prior} acts at contact {contact}, but the system has {have}; give the contact (`contacts`), or use a "
            "prior that needs none, such as JointFriction or ToolForces(frame=..., axes='world')."
        )


def require_moving(prior: str, frame: str, robot: Robot) -> None:
    """Raise UnknownFrame for a frame that does not exist, InvalidInput for one that is fixed in the world."""
    body, _ = robot.frame(frame)
    if body < 0:
        moving = [name for name in robot.link_names if robot.frame(name)[0] >= 0]
        raise InvalidInput(
            f"{prior} acts on frame {frame!r}, which is fixed in the world and never moves, so its forces move "
            f"nothing; give a frame of a moving link: {', '.join(moving)}."
        )
