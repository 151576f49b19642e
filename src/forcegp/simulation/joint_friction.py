"""Friction of the joints of plants, by the laws that models have."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from forcegp.forces.joint_law import JointLaw
from forcegp.forces.joint_laws import Viscous
from forcegp.forces.registry import parse_forces
from forcegp.mechanics.gauss_principle import State
from forcegp.robots import Robot

Numbers = Mapping[str, Any]
"""Coefficients by name, one number or one per joint; "velocity" stands for velocities that have no number here."""

Friction = Callable[..., Float[np.ndarray, "*batch nv"]]
"""(v, u, q), u [Nm or N] of the actuators, in joints; u, and q of a fixed base, may be None for 0 -> joint forces."""


def laws_of_joints(expression: str, robot: Robot, numbers: Numbers) -> Friction:
    """The laws of this expression (`parse_forces`) with viscous friction, step by step; none for "none".

    Coefficients that it does not give have these numbers, or their defaults.
    """
    forces = () if expression == "none" else parse_forces(expression)
    laws = forces if not forces or any(isinstance(force, Viscous) for force in forces) else (Viscous(), *forces)
    known = []
    for law in laws:
        assert isinstance(law, JointLaw), "`require_joint_friction` sees to it"
        found = {}
        for name, coefficient in law.coefficients.items():
            given = getattr(law, name)
            usual = numbers["velocity"] if coefficient.unit == "velocity" else coefficient.default
            found[name] = numbers.get(name, usual) if given is None else given
        known.append(law.with_values(found).bound_to(robot))

    def friction(v: np.ndarray, u: np.ndarray | None = None, q: np.ndarray | None = None) -> np.ndarray:
        at_u, at_q = (torch.tensor(np.zeros_like(v) if each is None else each) for each in (u, q))
        state = State(at_q, torch.tensor(v), at_u, robot)
        return sum((law.force(state).numpy() for law in known), np.zeros_like(v))

    return friction
