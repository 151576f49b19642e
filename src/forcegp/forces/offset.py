"""`Offset`: a constant force of each joint; `Spring`: one in proportion to its position."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from forcegp.forces.force import JointLaw, Number
from forcegp.forces.parameters import Coefficient
from forcegp.mechanics.gauss_principle import State


@dataclass(frozen=True, eq=False)
class Offset(JointLaw):
    """A constant of either sign in Nm or N: the offset of a torque sensor, or friction that differs by direction."""

    value: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {"value": Coefficient(lowest=-np.inf)}

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return parameters["value"] + torch.zeros_like(features[0])


@dataclass(frozen=True, eq=False)
class Spring(JointLaw):
    """-k (q - q0): a spring of `stiffness` k (Nm/rad or N/m) in each joint, at rest at the position `rest` q0."""

    stiffness: Number = None
    rest: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {
        "stiffness": Coefficient("force/position"),
        "rest": Coefficient("position", factor=1.0, lowest=-np.inf),
    }

    @override
    def features(self, state: State) -> tuple[Tensor, ...]:
        return (state.positions,)

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return -parameters["stiffness"] * (features[0] - parameters["rest"])
