"""`JointForces`: one independent Gaussian process per joint force, on (q, v, u); the prior of the paper."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.mechanics import ConstrainedDynamics
from forcegp.priors.force_prior import ForcePrior
from forcegp.priors.kernels import squared_exponential_kernel
from forcegp.robots import Robot

INPUTS = ("q", "v", "u")


@dataclass(frozen=True)
class JointForces(ForcePrior):
    """Q_U = f(x) with independent f_j ~ GP(0, k_j), one per joint (Rath et al. 2021, eqs. 5-7).

    The kernels are squared exponentials with one length scale per input. `inputs` chooses which of q, v and u the
    force may depend on.
    """

    inputs: tuple[str, ...] = INPUTS

    def __post_init__(self) -> None:
        object.__setattr__(self, "inputs", tuple(self.inputs))
        if (
            not self.inputs
            or any(name not in INPUTS for name in self.inputs)
            or len(set(self.inputs)) < len(self.inputs)
        ):
            raise InvalidInput(f"JointForces inputs are {self.inputs!r}; give one or more of 'q', 'v', 'u', each once.")

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return robot.joint_names

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        u = dynamics.state.u
        return torch.eye(u.shape[-1], dtype=u.dtype, device=u.device).expand_as(dynamics.H)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        states = {"q": dynamics.state.q, "v": dynamics.state.v, "u": dynamics.state.u}
        z = torch.cat([states[name] for name in self.inputs], dim=-1)
        return (z,) * dynamics.state.u.shape[-1]

    @override
    def kernels(self, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        # Standardised points in d dimensions are about sqrt(2 d) apart: shorter length scales start with a vanishing
        # gradient.
        return tuple(
            squared_exponential_kernel(dimension, math.sqrt(dimension), variance)
            for dimension, variance in zip(dimensions, variances, strict=True)
        )

    @override
    def to_dict(self) -> dict[str, Any]:
        return asdict(self)
