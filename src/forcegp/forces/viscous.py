"""`Viscous` friction, and friction that differs by direction."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from torch import Tensor
from typing_extensions import override

from forcegp.forces.force import JointLaw, Number
from forcegp.forces.parameters import Coefficient
from forcegp.mechanics.gauss_principle import State


@dataclass(frozen=True, eq=False)
class Viscous(JointLaw):
    """-d v with d in Nms/rad or Ns/m: one number, one per joint, or by joint name (joints not named have none)."""

    damping: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {"damping": Coefficient("force/velocity")}

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return -parameters["damping"] * features[0]


@dataclass(frozen=True, eq=False)
class DirectionalFriction(JointLaw):
    """-e |v| with e in Nms/rad or Ns/m, of either sign: viscous friction that differs by e from its mean by direction.

    With `Viscous` d it is d + e forwards and d - e backwards; `Offset` does the same for dry friction.
    """

    difference: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {"difference": Coefficient("force/velocity", lowest=-np.inf)}

    @override
    def features(self, state: State) -> tuple[Tensor, ...]:
        return (state.v.abs(),)

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return -parameters["difference"] * features[0]
