"""The torque regressor: joint forces of inverse dynamics as a matrix times the standard inertial parameters.

    tau = M(q) a + bias(q, v) - armature a = Y(q, v, a) pi

(Atkeson, An & Hollerbach, "Estimation of inertial parameters of manipulator loads and links", IJRR 1986). A *body* is
what one joint moves as one: its child link with every link fixed to it; only their sum shows in joint forces. Body i
has the parameters

    m [kg],  m cx, m cy, m cz [kg m],  Ixx, Ixy, Iyy, Ixz, Iyz, Izz [kg m^2]

about the origin and in the axes of the child link of joint i (Pinocchio's order); ``pi`` has them body after body.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.robots import Robot
from forcegp.robots.inertia import standard_of_pseudo_inertia

PARAMETERS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
"""Names of the standard parameters of one body; mx = m cx."""
UNITS = ("kg", *("kg m",) * 3, *("kg m^2",) * 6)
"""Their units."""


def torque_regressor(
    robot: Robot, q: Float[Tensor, "*#rows nv"], v: Float[Tensor, "*#rows nv"], a: Float[Tensor, "*#rows nv"]
) -> Float[Tensor, "... nv columns"]:
    """Y (..., nv, 10 nv) with ``Y @ standard_parameters(robot)`` the joint forces in Nm or N, without armature.

    Columns are named by `parameter_names`. Differentiable in all arguments. Raises InvalidInput for wrong shapes,
    dtypes or devices.
    """
    return robot.kinematics(q, v).torque_regressor(a).flatten(-2)


def standard_parameters(robot: Robot) -> Float[Tensor, "columns"]:
    """The parameters pi (10 nv,) that the robot's URDF gives, links fixed to one another merged."""
    return standard_of_pseudo_inertia(body_pseudo_inertias(robot)).flatten()


def body_pseudo_inertias(robot: Robot) -> Float[Tensor, "nv 4 4"]:
    """Pseudo-inertia of every body in the frame of its child link."""
    inverse = torch.linalg.inv(torch.as_tensor(robot.layout.child_frames, device=robot.device))
    return inverse @ robot.tree.inertias[..., 0] @ inverse.mT


def body_names(robot: Robot) -> tuple[str, ...]:
    """What the bodies are called: by the child link of their joint."""
    return tuple(joint.child for joint in robot.joints)


def parameter_names(robot: Robot) -> tuple[str, ...]:
    """Names of the regressor's columns: `LINK.m`, `LINK.mx`, ..., `LINK.Izz` for every body."""
    return tuple(f"{body}.{parameter}" for body in body_names(robot) for parameter in PARAMETERS)
