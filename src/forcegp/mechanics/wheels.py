"""Wheels and balls that roll without slipping on a plane: rows of the same constraint as contacts.

The point of the wheel that touches the ground with normal n lies at p + r d, where p is its centre, e its axis and d
the direction in its plane that points down most, d = -(n - (n.e) e) / |n - (n.e) e| (of a ball, d = -n). As a point of
the link it has no velocity. Along a direction t of the world,

    A v = t^T (p' + w x r d) = 0,    A' v = t^T (Jdot_p v + Jdot_w v x r d + w x r d'),

with d' as it moves on the rim, not with the link. Along n this is the derivative of the height of the rim; along
tangents it has no integral: such constraints are nonholonomic, and no position breaks them (Bloch, "Nonholonomic
Mechanics and Control" (2015), section 1.4).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.mechanics.gauss_principle import Contact, Row
from forcegp.mechanics.surfaces import Held, Plane, Vector, direction, positive, surface_axes
from forcegp.robots import Kinematics

LYING = 1e-9
"""Sine of the angle between axis and normal below which a wheel lies flat and touches everywhere."""


@dataclass(frozen=True)
class RollingContact(Contact):
    """The rim does not move along one direction, that of `surface`, where it touches; made by `rolling`.

    `point` is the centre of the wheel and `axis` its axis in the axes of `frame` (None for a ball), `radius` in m,
    `normal` that of the ground in the world.
    """

    radius: float = math.nan
    axis: Vector | None = None
    normal: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.surface, Held | Plane):
            kind = type(self.surface).__name__
            raise InvalidInput(f"RollingContact surface is a {kind}; give a Plane or Held, or use rolling(...).")
        object.__setattr__(self, "radius", positive("RollingContact radius", self.radius))
        object.__setattr__(self, "normal", direction("RollingContact normal", self.normal)[0])
        if self.axis is not None:
            object.__setattr__(self, "axis", direction("RollingContact axis", self.axis)[0])

    @override
    def position(self, kinematics: Kinematics) -> Float[Tensor, "*batch 3"]:
        """World position of the point that touches (..., 3) in m."""
        return super().position(kinematics) + self._arm(kinematics)[0]

    @override
    def row(self, kinematics: Kinematics, v: Float[Tensor, "*batch nv"] | None = None) -> Row:
        arm, axis, across = self._arm(kinematics)
        J_p, J_w = kinematics.frame_jacobian(self.frame, self.point).split(3, dim=-2)
        p = super().position(kinematics) + arm
        along = self.surface.gradient(p)
        A = (along[..., None, :] @ J_p + torch.linalg.cross(arm, along)[..., None, :] @ J_w)[..., 0, :]
        drift = None
        if v is not None:
            turning = (J_w @ v[..., None])[..., 0]
            moving = torch.zeros_like(arm)
            if axis is not None:  # arm = -r g / |g| with g = n - (n.e) e
                n = arm.new_tensor(self.normal)
                spin = torch.linalg.cross(turning, axis)
                change = -(spin @ n)[..., None] * axis - (axis @ n)[..., None] * spin
                unit = arm / self.radius
                moving = -self.radius * (change - unit * (unit * change).sum(-1, keepdim=True)) / across
            bias = kinematics.frame_bias_acceleration(self.frame, self.point)
            whole = bias[..., :3] + torch.linalg.cross(bias[..., 3:], arm) + torch.linalg.cross(turning, moving)
            drift = (along * whole).sum(-1)
        return Row(self.surface.value(p), A, along, drift)

    def _arm(self, kinematics: Kinematics) -> tuple[Tensor, Tensor | None, Tensor]:
        """From the centre to the point that touches; the axis of the wheel; |n - (n.e) e|."""
        pose = kinematics.frame_pose(self.frame)
        n = pose.new_tensor(self.normal).expand(*pose.shape[:-2], 3)
        if self.axis is None:
            return -self.radius * n, None, torch.ones_like(n[..., :1])
        axis = pose[..., :3, :3] @ pose.new_tensor(self.axis)
        g = n - (n * axis).sum(-1, keepdim=True) * axis
        across = torch.linalg.vector_norm(g, dim=-1, keepdim=True)
        across = torch.where(across > LYING, across, torch.nan)  # which check_states names
        return -self.radius * g / across, axis, across


def rolling(
    frame: str,
    radius: float,
    axis: Vector | None = (0.0, 1.0, 0.0),
    point: Vector = (0.0, 0.0, 0.0),
    ground: Plane | Held | None = None,
    switch: str | None = None,
) -> tuple[RollingContact, RollingContact, RollingContact]:
    """A wheel on link `frame` rolls without slipping: it neither leaves the ground nor slides forwards or sideways.

    `point` is its centre and `axis` its axis in the axes of the frame, None for a ball; `radius` in m. `ground` is a
    `Plane`, or `Held(normal)` where its height does not matter; by default it is level. The multipliers are the force
    on the wheel in N along the normal and two tangents, x and y on level ground.
    """
    ground = Held((0.0, 0.0, 1.0)) if ground is None else ground
    if not isinstance(ground, Held | Plane):
        raise InvalidInput(f"the ground is a {type(ground).__name__}; give a Plane, or Held(normal).")
    first, second, _ = surface_axes(torch.tensor(ground.normal, dtype=torch.float64)).T.tolist()
    wheel = (switch, radius, axis, ground.normal)
    return (
        RollingContact(frame, point, ground, *wheel),
        RollingContact(frame, point, Held(tuple(first)), *wheel),
        RollingContact(frame, point, Held(tuple(second)), *wheel),
    )
