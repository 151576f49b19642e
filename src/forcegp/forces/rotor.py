"""Rotors of motors, which turn with the joints: `Rotor`, one per joint, and `CoupledRotors`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.forces.force import JointLaw, Number, as_numbers
from forcegp.forces.parameters import Coefficient
from forcegp.robots import Robot


@dataclass(frozen=True, eq=False)
class Rotor(JointLaw):
    """Rotor inertia seen at the joint (kg m^2 or kg), added to the mass matrix on top of the robot's own `armature`."""

    inertia: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {"inertia": Coefficient("inertia")}

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return torch.zeros_like(features[0])

    @override
    def inertia_basis(self, robot: Robot) -> Tensor:
        T = self._turning(robot)
        return T[:, :, None] * T[:, None, :]

    def _turning(self, robot: Robot) -> Tensor:
        return torch.eye(robot.nv, dtype=torch.float64, device=robot.device)


@dataclass(frozen=True, eq=False)
class CoupledRotors(Rotor):
    """Rotors that turn with several joints: T^T diag(I) T added to the mass matrix, for rotor speeds T v.

    `inertia` I holds one rotor per joint (kg m^2), `transmission` T (nv, nv) how fast each rotor turns about its axis,
    in a frame that does not, per joint velocity. One motor per joint, in the joint: T is diagonal and holds the gear
    ratios, for which `Rotor` is shorter. A motor that sits on a moving link also turns with that link, and a
    differential couples two joints. With transmission None, T is the identity. Gyroscopic forces of the rotors are
    left out. Source: Murphy, Wen & Saridis, "Recursive calculation of geared robot manipulator dynamics", ICRA 1990.
    """

    transmission: Sequence[Sequence[float]] | Tensor | None = None

    @override
    def bound_to(self, robot: Robot) -> "CoupledRotors":
        given = torch.eye(robot.nv).tolist() if self.transmission is None else self.transmission
        matrix = as_numbers("CoupledRotors transmission", given, robot, f"{robot.nv} rows of numbers")
        if matrix.shape != (robot.nv, robot.nv) or not bool(torch.isfinite(matrix).all()):
            raise InvalidInput(
                f"CoupledRotors transmission has shape {tuple(matrix.shape)}; {robot.name} needs a finite matrix "
                f"({robot.nv}, {robot.nv}): a row per rotor, a column per joint {', '.join(robot.joint_names)}."
            )
        return replace(super().bound_to(robot), transmission=matrix)

    @override
    def _turning(self, robot: Robot) -> Tensor:
        return torch.as_tensor(self.transmission)
