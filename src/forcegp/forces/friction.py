"""Laws of joint friction: `Viscous`, by direction, `Coulomb`, with more near rest (`Stribeck`), and `LoadFriction`."""

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


DRY = "dry friction"
VELOCITY_SCALE = Coefficient("velocity", 0.01, 0.1, 0.03, 20.0, logarithm=True)


@dataclass(frozen=True, eq=False)
class Coulomb(JointLaw):
    """-c tanh(v / w): dry friction of `level` c in Nm or N, smoothed below `velocity_scale` w (rad/s or m/s)."""

    level: Number = None
    velocity_scale: Number = None
    part: ClassVar[str] = DRY
    coefficients: ClassVar[Mapping[str, Coefficient]] = {"level": Coefficient(), "velocity_scale": VELOCITY_SCALE}

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return -parameters["level"] * torch.tanh(features[0] / parameters["velocity_scale"])


@dataclass(frozen=True, eq=False)
class Stribeck(JointLaw):
    """-(c + b exp(-(v / v_s)^2)) tanh(v / w): dry friction that falls from c + b near rest to c in motion.

    `level` c and `breakaway` b in Nm or N, `stribeck_velocity` v_s and `velocity_scale` w in rad/s or m/s.
    Source: Olsson et al., "Friction models and friction compensation", Eur. J. Control (1998), eq. 4, with a smooth
    sign.
    """

    level: Number = None
    breakaway: Number = None
    stribeck_velocity: Number = None
    velocity_scale: Number = None
    part: ClassVar[str] = DRY
    coefficients: ClassVar[Mapping[str, Coefficient]] = {
        "level": Coefficient(),
        "breakaway": Coefficient(),
        "stribeck_velocity": Coefficient("velocity", 0.1, 0.3, 0.1, 10.0, logarithm=True),
        "velocity_scale": VELOCITY_SCALE,
    }

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        c, b, v_s, w = (parameters[name] for name in self.coefficients)
        return -(c + b * torch.exp(-((features[0] / v_s) ** 2))) * torch.tanh(features[0] / w)


@dataclass(frozen=True, eq=False)
class LoadFriction(JointLaw):
    """-(c + mu |u|) tanh(v / w): dry friction of a gear, which grows with the torque that it transmits.

    `level` c in Nm or N, `factor` mu without unit, `velocity_scale` w in rad/s or m/s. Source: Hamon, Gautier &
    Garrec, "Dynamic identification of robots with a dry friction model depending on load and velocity", IROS 2010,
    where the load is the output torque; here it is that of the actuator.
    """

    level: Number = None
    factor: Number = None
    velocity_scale: Number = None
    part: ClassVar[str] = DRY
    coefficients: ClassVar[Mapping[str, Coefficient]] = {
        "level": Coefficient(),
        "factor": Coefficient("1", highest=0.9),
        "velocity_scale": VELOCITY_SCALE,
    }
    under_load: ClassVar[bool] = True

    @override
    def features(self, state: State) -> tuple[Tensor, ...]:
        return state.v, state.delivered.abs()

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        c, mu, w = (parameters[name] for name in self.coefficients)
        return -(c + mu * features[1]) * torch.tanh(features[0] / w)
