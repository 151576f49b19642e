"""Closed loops as rows of the same A: A = n^T (J_a - J_b) where p_a = p_b along n (Featherstone 2008, section 8.2).

A multiplier is the force on the first frame. Rows of the orientation have the error 2 tan(t/2) k for a turn t about k.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import ContactError, InvalidInput
from forcegp.mechanics.gauss_principle import AXES, Contact, Row, placed
from forcegp.mechanics.surfaces import SURFACES, Held, object_from_dict, surface_to_dict
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


CONTACTS: dict[str, type[Contact]] = {"contact": Contact, "loop": LoopClosure}
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
