"""`NoForces`: nothing is unknown but the parameters of what is known; the analytical model."""

from __future__ import annotations

from dataclasses import dataclass

from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.mechanics import ConstrainedDynamics
from forcegp.priors.force_prior import ForcePrior
from forcegp.robots import Robot


@dataclass(frozen=True)
class NoForces(ForcePrior):
    """Q_U = 0: no latent function at all, so a = M^-1 Q_b + H Q_K + noise (Rath et al. 2021, eq. 4 with Q_z = 0).

    What can be fitted are learned noise and physical parameters, by maximum likelihood.
    """

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return ()

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return dynamics.H[..., :0]

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        return ()

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        return ()

    @override
    def kernels(self, robot: Robot, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        return ()
