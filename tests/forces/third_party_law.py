"""A law that forcegp does not bring, in one file: a spring that grows stiffer the farther its joint is turned."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch

from forcegp.forces import FORCES, Coefficient, JointLaw


@dataclass(frozen=True, eq=False)
class HardeningSpring(JointLaw):
    """-(k + c q^2) q, in Nm or N: a cable or a rubber that pulls each joint back to zero."""

    stiffness: object = None
    hardening: object = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {
        "stiffness": Coefficient("force/position"),
        "hardening": Coefficient("force/position^3"),
    }

    def features(self, state):
        return (state.positions,)

    def amplitude(self, features, parameters):
        (q,) = features
        return -(parameters["stiffness"] + parameters["hardening"] * torch.square(q)) * q


FORCES["hardening-spring"] = HardeningSpring
