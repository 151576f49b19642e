"""What a robot shows of its joints and links."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float
from torch import Tensor

from forcegp.robots.inertia import log_cholesky_of_link
from forcegp.robots.urdf import InertialDescription, JointDescription


@dataclass(frozen=True)
class Joint:
    """A movable joint. Positions in rad or m, velocities per s, efforts in Nm or N; missing limits are infinite."""

    name: str
    type: str  # 'revolute' | 'continuous' | 'prismatic'
    parent: str
    child: str
    axis: tuple[float, float, float]  # unit vector in the joint frame
    lower: float
    upper: float
    velocity_limit: float
    effort_limit: float
    damping: float  # Nms/rad or Ns/m
    friction: float  # Nm or N

    @classmethod
    def of(cls, joint: JointDescription) -> Joint:
        """What a description says about a movable joint, without its place in the tree."""
        return cls(**{field.name: getattr(joint, field.name) for field in fields(cls)})


@dataclass(frozen=True)
class Link:
    """A link with the inertia that the URDF gives it; ``joint`` moves it (None: fixed in the world)."""

    name: str
    joint: str | None
    mass: float  # kg; 0 for a massless frame
    center_of_mass: tuple[float, float, float]  # m, in the link frame
    inertia: tuple[tuple[float, float, float], ...]  # kg m^2 about the centre of mass, in the axes of the link frame

    @classmethod
    def of(cls, name: str, joint: str | None, inertial: InertialDescription | None) -> Link:
        """A link with its inertia; without one it is a massless frame."""
        if inertial is None:
            return cls(name, joint, 0.0, (0.0, 0.0, 0.0), ((0.0, 0.0, 0.0),) * 3)
        rows = tuple(tuple(row) for row in inertial.inertia.tolist())
        return cls(name, joint, inertial.mass, tuple(inertial.center_of_mass.tolist()), rows)

    def log_cholesky(self, owner: str) -> Float[Tensor, "10"]:
        """Log-Cholesky parameters; ``owner`` is the robot that error messages name. Raises as log_cholesky_of_link."""
        center, inertia = np.array(self.center_of_mass), np.array(self.inertia)
        return log_cholesky_of_link(self.mass, center, inertia, f"{self.name!r} of {owner}")
