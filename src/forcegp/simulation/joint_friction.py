"""Friction of joints by name, of all plants."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from forcegp.forces.force import Law
from forcegp.forces.joint_law import JointLaw
from forcegp.forces.joint_laws import Viscous
from forcegp.forces.registry import parse_forces
from forcegp.mechanics.gauss_principle import State
from forcegp.robots import Robot

Numbers = Mapping[str, Any]
"""Coefficients by name, one number or one per joint; "velocity" stands for velocities that have no number here."""


@dataclass(frozen=True, eq=False)
class LawsOfJoints:
    """What laws make of velocities, step by step."""

    robot: Robot
    laws: tuple[Law, ...]

    @classmethod
    def named(cls, expression: str, robot: Robot, numbers: Numbers) -> "LawsOfJoints":
        """The laws of this expression (`parse_forces`) with viscous friction; none for "none".

        Coefficients that it does not give have these numbers, or their defaults.
        """
        forces = () if expression == "none" else parse_forces(expression)
        laws = forces if not forces or any(isinstance(force, Viscous) for force in forces) else (Viscous(), *forces)
        out = []
        for law in laws:
            assert isinstance(law, JointLaw), "`require_joint_friction` sees to it"
            found = {}
            for name, coefficient in law.coefficients.items():
                given = getattr(law, name)
                usual = numbers["velocity"] if coefficient.unit == "velocity" else coefficient.default
                found[name] = numbers.get(name, usual) if given is None else given
            out.append(law.with_values(found).bound_to(robot))
        return cls(robot, tuple(out))

    def __call__(
        self, v: Float[np.ndarray, "*batch nv"], u: np.ndarray | None = None
    ) -> Float[np.ndarray, "*batch nv"]:
        """Joint forces [Nm or N] with the sign that accelerates; u [Nm or N] is that of the actuators."""
        at = torch.tensor(v)
        state = State(torch.zeros_like(at), at, torch.zeros_like(at) if u is None else torch.tensor(u), self.robot)
        return sum((law.force(state).numpy() for law in self.laws), np.zeros_like(v))
