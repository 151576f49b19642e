"""What a robot shows of its joints and links."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.robots.inertia import log_cholesky_of_link
from forcegp.robots.urdf import InertialDescription, JointDescription

INERTIAL_PARTS = ("mass", "com", "inertia")
ALIASES = {"center_of_mass": "com"}


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
        """A movable joint as a description has it, without its place in the tree."""
        return cls(**{field.name: getattr(joint, field.name) for field in fields(cls)})


@dataclass(frozen=True)
class LinkInertia:
    """Some of a link's inertial parameters, to be estimated: ``parts`` out of 'mass', 'com' and 'inertia'.

    What is not named keeps its physical value: the centre of mass in the link frame, and the inertia *about* it.
    """

    link: str
    parts: tuple[str, ...] = INERTIAL_PARTS

    def __post_init__(self) -> None:
        if isinstance(self.parts, str):
            raise InvalidInput(f"parts is the text {self.parts!r}; give a tuple such as ({self.parts!r},)")
        parts = tuple(dict.fromkeys(ALIASES.get(part, part) for part in self.parts))
        unknown = next((part for part in parts if part not in INERTIAL_PARTS), None)
        if unknown is not None or not parts:
            given = "nothing" if unknown is None else repr(unknown)
            raise InvalidInput(
                f"a link has the inertial parts {', '.join(INERTIAL_PARTS)}, and {given} was asked of {self.link!r}; "
                "name one or more of them."
            )
        object.__setattr__(self, "parts", parts)


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

    def inertial(self, *parts: str) -> LinkInertia:
        """Parts to learn, for ``StructuredGP.identify``: 'mass', 'com', 'inertia'; all three if none is named.

        'center_of_mass' means 'com'. Raises :class:`~forcegp.errors.InvalidInput` for other parts.
        """
        return LinkInertia(self.name, parts or INERTIAL_PARTS)
