"""`JointAccelerations`: Gaussian processes on the unconstrained acceleration; the S-GP of Geist & Trimpe (2020)."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.mechanics import ConstrainedDynamics
from forcegp.priors.joint_forces import JointForces
from forcegp.priors.joint_units import joint_units
from forcegp.robots import Robot


@dataclass(frozen=True)
class JointAccelerations(JointForces):
    """Q_U = M f(x): the processes f_j are the acceleration (rad/s^2, m/s^2) that an unconstrained robot would have.

    Then H M f = f - M^-1 A^T (A M^-1 A^T)^+ A f, the projection of f onto what the constraint allows (Geist & Trimpe
    2020, "Learning constrained dynamics with Gauss' principle adhering Gaussian processes", the S-GP [38] of Rath et
    al. 2021). With the mean "zero" the processes carry gravity and actuation, too. Without contacts H M is the
    identity, and this is an independent Gaussian process per joint.
    """

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return dynamics.M

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return joint_units("a", robot.joint_names, robot)
