"""`Actuation`: what the actuators deliver."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, require_type
from forcegp.forces.force import Law, as_numbers
from forcegp.mechanics.gauss_principle import State
from forcegp.robots import Robot


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
