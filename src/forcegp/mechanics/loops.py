"""Closed loops: two frames of one robot that are held together, as rows of the same constraint as contacts.

A tree with a loop is the tree whose two ends meet: with p_a - p_b = 0 along each axis n of the world,

    A = n^T (J_a - J_b),    b = -n^T (Jdot_a v - Jdot_b v) - 2 zeta omega A v - omega^2 n^T (p_a - p_b),

and the multiplier is the force on the first frame in N, its opposite that on the second one (Featherstone, "Rigid Body
Dynamics Algorithms" (2008), section 8.2, whose loop constraints have axes of a link). Rows that hold the orientation
are the same with angular velocities; their error is 2 tan(t/2) k for a turn by t about k from the second frame to the
first, which is t k near 0, and their multiplier a torque in Nm. In planar mechanisms some rows constrain nothing: they
are redundant, which is legal.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import ContactError, InvalidInput
from forcegp.mechanics.gauss_principle import AXES, Contact, Row, placed
from forcegp.mechanics.surfaces import Held
from forcegp.robots import Kinematics, Robot
from forcegp.robots.arguments import finite_vector
from forcegp.robots.mjcf_model import LoopDescription

Point = tuple[float, float, float]


@dataclass(frozen=True)
class LoopClosure(Contact):
    """Two points of the robot do not move apart along one axis of the world; made by `loop_point` and `loop_frame`.

    `second_point` is given in m in the axes of `second_frame`. With `turning` the frames do not turn against each other
    about that axis instead.
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
    """A point of one frame is a point of another one, as in a joint that closes a loop: three rows, along x, y and z.

    Points are given in m in the axes of their frames. The multipliers are the force on the first frame in N, in the
    axes of the world.
    """
    return tuple(LoopClosure(frame_a, point_a, Held(axis), switch, frame_b, point_b) for axis in AXES)


def loop_frame(frame_a: str, frame_b: str, switch: str | None = None) -> tuple[LoopClosure, ...]:
    """Two frames are the same one, as where a loop is welded: six rows, along and about x, y and z of the world.

    The multipliers are force in N and torque in Nm on the first frame. Half a turn from each other, the orientation has
    no error that is finite.
    """
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
