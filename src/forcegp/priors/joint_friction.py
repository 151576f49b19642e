"""`JointFriction`: one friction curve per joint, a function of that joint's velocity alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.mechanics import ConstrainedDynamics
from forcegp.priors.expressed_kernels import ExpressedKernels
from forcegp.priors.force_prior import Scaling
from forcegp.priors.kernels import check_kernel
from forcegp.priors.per_joint import PerJointPrior, chosen_joints
from forcegp.robots import Robot


@dataclass(frozen=True)
class JointFriction(PerJointPrior, ExpressedKernels):
    """Q_U,j = -f_j(v_j): what resists joint j, positive for positive velocity, an independent function per joint.

    The kernel "friction" gives f_j(v) = tanh(v / w) g(v) + d v with a learned velocity scale w and an unknown level g
    (`priors/friction_kernel.py`): Coulomb, Stribeck and viscous friction, zero at rest, and different in the two
    directions if the data show it (Armstrong-Helouvry, Dupont & Canudas de Wit 1994 list these parts). Velocities are
    only scaled, never shifted, so that zero stays zero. `joints` restricts the prior to some joints, by name.
    """

    depends_on: ClassVar[Literal["q", "v"]] = "v"

    joints: tuple[str, ...] | None = None
    kernel: str = "friction"

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", chosen_joints(type(self).__name__, self.joints))
        check_kernel(self.kernel)

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return -super().mixing(dynamics)

    @override
    def scalings(self, robot: Robot) -> tuple[Scaling, ...]:
        return ("scale",) * len(self.latent_names(robot))
