"""`JointLaw`: a law that acts in every joint by itself, or in motors that turn with several joints."""

import re
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, fields, replace
from math import nan
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.forces.force import Coefficient, Law, LogNormal, Normal, as_numbers
from forcegp.mechanics.gauss_principle import State
from forcegp.robots import Robot
from forcegp.robots.arguments import by_joint

AnyJointLaw = TypeVar("AnyJointLaw", bound="JointLaw")
Transmission = str | Sequence[Sequence[float]] | np.ndarray | Tensor | None


class PerJointLaw(Law):
    """A law with one coefficient per joint, on which its amplitude depends alone. `features`: (..., nv) each."""

    def _bound(self, name: str, robot: Robot) -> Any:
        given, coefficient = getattr(self, name), self.coefficients[name]
        if isinstance(given, Normal | LogNormal):
            first, second = (f.name for f in fields(given))
            spread = getattr(given, second)
            parts = {first: self._numbers(name, getattr(given, first), robot, coefficient)}
            if spread is not None:
                parts[second] = self._numbers(name, spread, robot, Coefficient("1"), weak=True)
            return replace(given, **parts)
        if given is None and name in self.learned:
            return None
        return self._numbers(name, coefficient.default if given is None else given, robot, coefficient)

    def _numbers(self, name: str, given: Any, robot: Robot, coefficient: Coefficient, weak: bool = False) -> Tensor:
        """One per joint, checked; those of weak priors may be nan."""
        what = f"{type(self).__name__} {name}"
        if weak and isinstance(given, tuple | list):
            given = [nan if entry is None else entry for entry in given]
        remedy = "a number, one per joint, or a mapping from joint names"
        values = as_numbers(what, by_joint(given, robot.joint_names, robot.name), robot, remedy)
        if values.dim() == 0:  # one number for every joint, but not for bases that move
            driven = [joint in robot.single_joint_names or coefficient.logarithm for joint in robot.joint_names]
            values = values * torch.tensor(driven, dtype=values.dtype, device=values.device)
        values = values.clone()  # which keeps the graph
        if values.shape != (robot.nv,):
            seen = f"{what} has {tuple(values.shape)} values"
            raise InvalidInput(f"{seen}; {robot.name} has {robot.nv} joints: {', '.join(robot.joint_names)}")
        least = "a finite number"
        checked = torch.where(values.isnan(), 1.0, values) if weak else values
        good = torch.isfinite(checked)
        if coefficient.logarithm:
            good, least = good & (checked > 0), "a finite number > 0"
        elif coefficient.lowest == 0.0:
            good, least = good & (checked >= 0), "a finite number >= 0"
        if not bool(good.all()):
            raise InvalidInput(f"{what} is {values.tolist()}; every joint needs {least}.")
        return values


@dataclass(frozen=True, eq=False)
class JointLaw(PerJointLaw):
    """A law that acts in every joint of one degree of freedom by itself: all coefficients have one value per joint.

    The amplitude of a joint depends on the coefficients of that joint alone. `features` are (..., nv) each; joints of
    several degrees of freedom, such as a base that moves, have coefficients 0.

    `transmission` T (nv, nv) lets it act in motors that turn with several joints, at T v, with joint forces T^T f;
    coefficient j is that of motor j. As a text it has the rows in which T differs from the identity:
    "joint_6+joint_5" for a motor of joint 6 that turns with both, "joint_6-0.5*joint_5/joint_3+joint_2".
    """

    in_gear: ClassVar[bool] = True
    transmission: Transmission = field(default=None, kw_only=True)

    @override
    def seen(self, state: State) -> State:
        """With velocities, positions, delivered forces of the motors."""
        if self.transmission is None:
            return state
        own, turned = copy(state), {"v": self.turning(state.v), "positions": self.turning(state.positions)}
        vars(own).update(turned, delivered_by=lambda _: self.at_motors(state.delivered), kinematics=state.kinematics)
        return own

    @override
    def direction(self, state: State) -> Tensor | None:
        return None if self.transmission is None else torch.as_tensor(self.transmission).mT

    @override
    def bound_to(self: AnyJointLaw, robot: Robot) -> AnyJointLaw:
        numbers = {name: self._bound(name, robot) for name in self.coefficients}
        return replace(self, transmission=bound_transmission(type(self).__name__, self.transmission, robot), **numbers)


def bound_transmission(owner: str, given: Transmission, robot: Robot) -> Tensor | None:
    """The matrix (nv, nv), of joints of one degree of freedom; None: the identity. Raises InvalidInput."""
    if given is None:
        return None
    what, nv = f"{owner} transmission", robot.nv
    if isinstance(given, str):
        term = f"([+-]?)(?:([0-9.]+)\\*)?({'|'.join(sorted(map(re.escape, robot.joint_names), key=len)[::-1])})"
        matrix = torch.eye(nv, dtype=torch.float64, device=robot.device)
        for row in given.replace(" ", "").split("/"):
            if not re.fullmatch(f"({term})+", row):
                example = f"{robot.joint_names[-1]}+{robot.joint_names[-2 % nv]}, with / between motors"
                advice = f"write the joints that a motor turns with, its own first, as in {example}."
                raise InvalidInput(f"{what} is {given!r}; {advice}")
            terms = [(sign, size, robot.joint_names.index(name)) for sign, size, name in re.findall(term, row)]
            for sign, size, j in terms:
                matrix[terms[0][2], j] = float(f"{sign}{size or 1.0}")
    else:
        matrix = as_numbers(what, given, robot, f"{nv} rows of numbers")
    free = [j for j, name in enumerate(robot.joint_names) if name not in robot.single_joint_names]
    if matrix.shape != (nv, nv) or not bool(torch.isfinite(matrix).all() and torch.linalg.matrix_rank(matrix) == nv):
        seen = f"{what} has shape {tuple(matrix.shape)}; {robot.name} needs a finite regular matrix ({nv}, {nv})"
        advice = f"a row per motor, a column per joint {', '.join(robot.joint_names)}."
        raise InvalidInput(f"{seen}: {advice}")
    one = torch.eye(nv).to(matrix)
    if bool((matrix != one)[free].any() | (matrix != one)[:, free].any()):
        raise InvalidInput(f"{what} has other numbers than the identity at a base that moves, which has no motor.")
    return None if torch.equal(matrix, one) else matrix
