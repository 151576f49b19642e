"""What laws need of the torque of each joint: columns of least squares, for who asks how much a law explains."""

from collections.abc import Iterable
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.forces.force import JointLaw, Law
from forcegp.forces.friction import Coulomb, Viscous
from forcegp.forces.offset import Offset
from forcegp.forces.rotor import Rotor
from forcegp.mechanics.gauss_principle import State
from forcegp.robots import Kinematics, Robot

Values = Float[np.ndarray, "rows nv"]
Inputs = Float[np.ndarray, "rows nu"]


class LazyState(State):
    """A state, unchecked, whose kinematics are computed where a law asks for them: most laws of joints do not."""

    def __init__(self, robot: Robot, q: Tensor, v: Tensor, u: Tensor) -> None:
        given = {"q": q, "v": v, "u": u, "robot": robot, "bodies": None, "inputs": (), "delivered_by": None}
        for name, value in given.items():
            object.__setattr__(self, name, value)

    @cached_property
    def kinematics(self) -> Kinematics:  # type: ignore[override]  # a field of a `State`
        """Of all bodies."""
        return self.robot.kinematics(self.q, self.v)


def law_columns(laws: Iterable[Law], robot: Robot, q: np.ndarray, v: Values, u: Inputs, a: Values) -> list[Values]:
    """The torque [Nm or N] that each law of joints needs at these states, of numbers that it is given.

    Laws without numbers count as 1: of a law that is linear in its first coefficient the column is the regressor.
    """
    state = LazyState(robot, *(torch.tensor(np.array(x), device=robot.device) for x in (q, v, u)))
    out = []
    for law in laws:
        if not isinstance(law, JointLaw):
            continue
        first = next(iter(law.coefficients))
        own = (law.with_values({first: 1.0}) if first in law.learned else law).bound_to(robot)  # type: ignore[dict-item]  # a number is one of what coefficients take
        with torch.no_grad():
            needed = -own.force(state).cpu().numpy()
            inertia = own.added_inertia(robot)
        out.append(needed if inertia is None else needed + a @ inertia.cpu().numpy().T)
    return out


def usual_columns(
    robot: Robot, q: np.ndarray, v: Values, u: Values, a: Values, widths: Iterable[float]
) -> list[Values]:
    """Of a rotor, viscous friction, dry friction of several widths, and an offset.

    Widths are relative to the root mean square velocity; several of them together are nearly any curve of friction.
    """
    speed = np.square(v).mean(axis=0) ** 0.5 + 1e-12
    dry = (Coulomb(1.0, torch.tensor(width * speed)) for width in widths)
    return law_columns([Rotor(), Viscous(), *dry, Offset(-1.0)], robot, q, v, u, a)
