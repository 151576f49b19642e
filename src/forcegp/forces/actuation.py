"""`Actuation`: what the actuators deliver."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, require_type
from forcegp.forces.force import Force, Law, as_numbers
from forcegp.forces.friction import Coulomb, Viscous
from forcegp.forces.offset import Spring
from forcegp.forces.rigid_bodies import RigidBodies
from forcegp.forces.thrusters import Thrusters
from forcegp.mechanics.gauss_principle import State
from forcegp.robots import Robot
from forcegp.robots.mjcf_model import Translation


@dataclass(frozen=True, eq=False)
class Actuation(Law):
    """What the actuators deliver: `matrix` u with `matrix` (nv, nu), one column per actuator, called `names`.

    Without a matrix there is one actuator per joint of one degree of freedom, u = its force; bases that move have none.
    Couplings and differentials are columns with several entries, without unit or in rad/rad. With `known` False u has
    these columns, and what they do is left to the unknown forces.
    """

    matrix: Sequence[Sequence[float]] | np.ndarray | Tensor | None = None
    names: tuple[str, ...] = ()
    known: bool = True

    def __post_init__(self) -> None:
        require_type("Actuation known", self.known, bool)

    @override
    def bound_to(self, robot: Robot) -> "Actuation":
        if self.matrix is None:
            free = {row for group in robot.layout.groups for row in range(*group.rows.indices(robot.nv))}
            if not free:
                return Actuation(None, robot.joint_names, self.known)
            driven = [row for row in range(robot.nv) if row not in free]
            matrix = torch.eye(robot.nv, dtype=torch.float64, device=robot.device)[:, driven]
            return Actuation(matrix, tuple(robot.joint_names[row] for row in driven), self.known)
        matrix = as_numbers("Actuation matrix", self.matrix, robot, f"{robot.nv} rows of numbers")
        names = tuple(self.names) or tuple(f"actuator_{k + 1}" for k in range(matrix.shape[-1] if matrix.dim() else 0))
        if matrix.dim() != 2 or len(matrix) != robot.nv or not bool(torch.isfinite(matrix).all()):
            raise InvalidInput(
                f"Actuation matrix has shape {tuple(matrix.shape)}; {robot.name} needs finite numbers in {robot.nv} "
                f"rows, one per degree of freedom: {', '.join(robot.joint_names)}."
            )
        if len(names) != matrix.shape[1] or len(set(names)) != len(names):
            raise InvalidInput(f"Actuation names are {names}; give {matrix.shape[1]} different ones, one per column.")
        return Actuation(matrix, names, self.known)

    def delivered(self, state: State) -> Tensor:
        """Joint forces (..., nv) of the actuators."""
        u = state.u[..., : len(self.names)]
        return u if self.matrix is None else u @ torch.as_tensor(self.matrix).mT

    @override
    def features(self, state: State) -> tuple[Tensor, ...]:
        return (self.delivered(state),)

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return features[0] if self.known else torch.zeros_like(features[0])


def forces_of_file(robot: Robot) -> tuple[Force, ...]:
    """What a robot's file states: actuation, rigid bodies, and joint damping and dry friction where it has them."""
    named = {joint.name: joint for joint in robot.joints if joint.name in robot.single_joint_names}
    damping = {name: joint.damping for name, joint in named.items() if joint.damping}
    friction = {name: joint.friction for name, joint in named.items() if joint.friction}
    laws = ((Viscous(damping),) if damping else ()) + ((Coulomb(friction),) if friction else ())
    return (Actuation(), RigidBodies(), *laws)


def forces_of_mjcf(robot: Robot, found: Translation) -> tuple[Force, ...]:
    """The same and springs; u are joint forces, or the inputs of all motors where some act elsewhere.

    Those of bodies that are not free come last.
    """
    actuation, moving = Actuation(), set(robot.joint_names)  # without those that are locked
    motors = [each for each in found.motors if moving & set(each.column)]
    pushing = [each for each in found.motors if each.link and robot.frame(each.link)[0] >= 0]
    if pushing or any(moving & set(each.column) - set(robot.single_joint_names) for each in motors):
        matrix = [[each.column.get(joint, 0.0) for each in motors] for joint in robot.joint_names]
        actuation = Actuation(matrix, tuple(each.name for each in motors))
    thrusters = (Thrusters.of_wrench(each.link, each.wrench, each.name) for each in pushing)
    sprung = {name: each for name, each in found.springs.items() if name in moving}
    stiffness, rest = ({name: each[k] for name, each in sprung.items()} for k in (0, 1))
    springs = (Spring(stiffness, rest),) if sprung else ()
    return (actuation, *thrusters, *forces_of_file(robot)[1:], *springs)
