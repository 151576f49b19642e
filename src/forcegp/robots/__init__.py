"""URDF text -> `Robot`: joints, links, frames, inertial parameters and differentiable rigid-body algorithms."""

from forcegp.robots.inertia import (
    parameters_from_physical,
    physical_from_parameters,
    pseudo_inertia_from_parameters,
)
from forcegp.robots.kinematics import Kinematics
from forcegp.robots.parts import Joint, Link, LinkInertia
from forcegp.robots.robot import Robot

__all__ = [
    "Joint",
    "Kinematics",
    "Link",
    "LinkInertia",
    "Robot",
    "parameters_from_physical",
    "physical_from_parameters",
    "pseudo_inertia_from_parameters",
]
