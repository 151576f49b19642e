"""Closed loops and rolling wheels as rows of the same A.

A loop: A = n^T (J_a - J_b) with p_a = p_b along axes n of the world; its multiplier is the force on the first frame
(Featherstone 2008, section 8.2). Rows of the orientation have the error 2 tan(t/2) k for a turn by t about k, and
torques as multipliers. A wheel of axis e touches at p + r d, d = -(n - (n.e) e) / |n - (n.e) e| (a ball: d = -n):

    A v = t^T (p' + w x r d) = 0,    A' v = t^T (Jdot_p v + Jdot_w v x r d + w x r d')

with d' as it moves on the rim (nonholonomic along tangents: Bloch 2015, section 1.4).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import ContactError, InvalidInput
from forcegp.mechanics.gauss_principle import AXES, Contact, Row, placed
from forcegp.mechanics.surfaces import (
    SURFACES,
    Held,
    Plane,
    Vector,
    direction,
    object_from_dict,
    positive,
    surface_axes,
    surface_to_dict,
)
from forcegp.robots import Kinematics, Robot
from forcegp.robots.arguments import finite_vector
from forcegp.robots.mjcf_model import LoopDescription

Point = tuple[float, float, float]


@dataclass(frozen=True)
class LoopClosure(Contact):
    """Two points of the robot do not move apart along one axis of the world; made by `loop_point` and `loop_frame`.

    `second_point` is in m in `second_frame`. With `turning` the frames do not turn against each other about that axis.
    """

    surface: Held
    second_frame: str = ""
    second_point: Point = (0.0, 0.0, 0.0)
    turning: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.second_frame, str) or not isinstance(self.surface, Held):
            raise InvalidInput(
                f"LoopClosure of {self.frame!r} has the second frame {self.second_frame!r} and the surface "
                f"{self.surface!r}; give the name of a link, and Held(axis), or use loop_point."
            )
        meaning = f" x, y, z in m, in frame {self.second_frame!r}"
        point = finite_vector("LoopClosure second_point", self.second_point, 3, meaning)
        object.__setattr__(self, "second_point", tuple(point.tolist()))

    @override
    def check(self, robot: Robot) -> None:
        if robot.frame(self.frame)[0] == robot.frame(self.second_frame)[0]:
            raise ContactError(
                f"frames {self.frame!r} and {self.second_frame!r} of {robot.name} do not move against each other, so "
                "they close no loop; name frames of two bodies."
            )

    @property
    def _ends(self) -> tuple[tuple[str, Point], tuple[str, Point]]:
        return (self.frame, self.point), (self.second_frame, self.second_point)

    @override
    def distance(self, kinematics: Kinematics) -> Float[Tensor, "*batch"]:
        """n^T (p_a - p_b) in m, or the error of the orientation about n: 0 where the loop is closed."""
        (R_a, p_a), (R_b, p_b) = (placed(kinematics, *end) for end in self._ends)
        if not self.turning:
            return self._along(p_a - p_b)
        turn = R_a @ R_b.mT
        sines = torch.stack([turn[..., i, j] - turn[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1)
        return self._along(sines) * 2.0 / (1.0 + turn.diagonal(dim1=-2, dim2=-1).sum(-1))

    @override
    def row(self, kinematics: Kinematics, v: Float[Tensor, "*batch nv"] | None = None) -> Row:
        rows = slice(3, 6) if self.turning else slice(0, 3)
        J_a, J_b = (kinematics.frame_jacobian(*end)[..., rows, :] for end in self._ends)
        normal = self.surface.gradient(self.position(kinematics))
        A = (normal[..., None, :] @ (J_a - J_b))[..., 0, :]
        drift = None
        if v is not None:
            a, b = (kinematics.frame_bias_acceleration(*end)[..., rows] for end in self._ends)
            drift = self._along(a - b)
        return Row(self.distance(kinematics), A, normal, drift)

    def _along(self, vector: Tensor) -> Tensor:
        return (vector * self.surface.gradient(vector)).sum(-1)


def loop_point(
    frame_a: str, point_a: Point, frame_b: str, point_b: Point, switch: str | None = None
) -> tuple[LoopClosure, ...]:
    """A point (m) of one frame is a point of another one, as in a joint that closes a loop: rows along x, y and z.

    The multipliers are the force on the first frame in N, in the axes of the world.
    """
    return tuple(LoopClosure(frame_a, point_a, Held(axis), switch, frame_b, point_b) for axis in AXES)


def loop_frame(frame_a: str, frame_b: str, switch: str | None = None) -> tuple[LoopClosure, ...]:
    """Two frames are one, as in a welded loop: six rows; multipliers in N and Nm on the first, in world axes."""
    origin = (0.0, 0.0, 0.0)
    turns = (LoopClosure(frame_a, origin, Held(axis), switch, frame_b, origin, turning=True) for axis in AXES)
    return (*loop_point(frame_a, origin, frame_b, origin, switch), *turns)


def closing(loop: LoopDescription) -> tuple[LoopClosure, ...]:
    """The contacts that close a loop of a file."""
    if loop.turning:
        return loop_frame(*loop.frames)
    return loop_point(loop.frames[0], loop.points[0], loop.frames[1], loop.points[1])


def described(loops: Sequence[LoopClosure]) -> list[LoopDescription]:
    """Loops for a file: one for all contacts between the same two points."""
    ends: dict[Any, bool] = {}
    for loop in loops:
        key = (loop.frame, loop.second_frame), (loop.point, loop.second_point)
        ends[key] = ends.get(key, False) or loop.turning
    return [LoopDescription(f"loop_{k}", x, y, turning) for k, ((x, y), turning) in enumerate(ends.items(), 1)]


LYING = 1e-9
"""Sine of the angle between axis and normal below which a wheel lies flat and touches everywhere."""


@dataclass(frozen=True)
class RollingContact(Contact):
    """The rim does not move along the direction of `surface` where it touches; made by `rolling`.

    `point` is the centre of the wheel, `axis` its axis in `frame` (None for a ball), `radius` in m, `normal` the
    ground's.
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

    `point` is its centre (m) and `axis` its axis in the frame, None for a ball; `radius` in m. `ground` is a `Plane`,
    or `Held(normal)` where its height does not matter; by default level. Multipliers are N along normal and two
    tangents.
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


CONTACTS: dict[str, type[Contact]] = {"contact": Contact, "loop": LoopClosure, "rolling": RollingContact}
"""By the name that files have for them."""


def contact_to_dict(contact: Contact) -> dict[str, Any]:
    """Its name in `CONTACTS` and its fields. Raises ContactError for other contacts and a surface that holds code."""
    name = next((name for name, kind in CONTACTS.items() if type(contact) is kind), None)
    if name is None:
        raise ContactError(f"a {type(contact).__name__} cannot be stored; files carry {', '.join(CONTACTS)}.")
    given = {each.name: getattr(contact, each.name) for each in fields(contact)}
    listed = {key: list(value) if isinstance(value, tuple) else value for key, value in given.items()}
    return {"type": name, **listed, "surface": surface_to_dict(contact.surface)}


def contact_from_dict(entry: Mapping[str, Any]) -> Contact:
    """The contact that `contact_to_dict` stored. Raises KeyError or TypeError for anything else."""
    given: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()}
    given["surface"] = object_from_dict("surface", SURFACES, given["surface"])
    return CONTACTS[given.pop("type")](**given)
