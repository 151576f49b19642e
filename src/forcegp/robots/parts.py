"""What a robot shows of its joints and links."""

from __future__ import annotations

from dataclasses import dataclass


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


@dataclass(frozen=True)
class Link:
    """A link with the inertia that the URDF gives it; ``joint`` moves it (None: fixed in the world)."""

    name: str
    joint: str | None
    mass: float  # kg; 0 for a massless frame
    center_of_mass: tuple[float, float, float]  # m, in the link frame
    inertia: tuple[tuple[float, float, float], ...]  # kg m^2 about the centre of mass, in the axes of the link frame
