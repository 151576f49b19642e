"""`StateForces`: the forces of a fitted model at a batch of states, by torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from forcegp.inference import LatentPosterior
from forcegp.mechanics import ConstrainedDynamics, MechanicalSystem
from forcegp.models.prediction import Gaussian
from forcegp.models.structured.components import Latents, components_of
from forcegp.priors import ForcePrior


class PredictedForces(NamedTuple):
    """The forces behind an acceleration at a state or at n states, as `Prediction` and `Components` have them.

    `unknown_force` Q_U (nv,) in Nm or N; `multiplier` lambda (m,) and the world force of every contact on the robot
    `contact_force` (3 m,) in N, known forces included; `components` holds the joint force (nv,) of every term of the
    prior, by name.
    """

    unknown_force: Gaussian
    multiplier: Gaussian
    contact_force: Gaussian
    components: Mapping[str, Gaussian]

    def of(self, row: int) -> PredictedForces:
        """Those of one of the states."""
        joint, multiplier, contact, parts = self
        return PredictedForces(
            joint[row], multiplier[row], contact[row], {name: part[row] for name, part in parts.items()}
        )


@dataclass(frozen=True, eq=False)
class StateForces:
    """Physics, prior and the posterior of its processes; `known`: whether the known forces act beside the unknown."""

    system: MechanicalSystem
    prior: ForcePrior
    known: bool
    inertials: Mapping[str, Tensor] | None
    standardize: Callable[[Sequence[Tensor]], Sequence[Tensor]]
    latent: LatentPosterior
    widening: float

    def dynamics(
        self, q: Float[Tensor, "n nv"], v: Float[Tensor, "n nv"], u: Float[Tensor, "n nv"]
    ) -> ConstrainedDynamics:
        """The constrained dynamics with the model's inertial parameters."""
        return self.system.dynamics(q, v, u, self.inertials)

    def latents(self, dynamics: ConstrainedDynamics, covariance: bool) -> Latents:
        """All processes at a batch of states."""
        batch = dynamics.state.q.shape[:-1]
        given = self.standardize(self.prior.features(dynamics))
        features = [z.reshape(batch.numel(), z.shape[-1]) for z in given]
        latents = len(features)
        if not latents:
            nothing = dynamics.state.q.new_zeros(*batch, 0, 0)
            return Latents(nothing.flatten(-2), nothing if covariance else None)
        mean = self.latent.mean(features).reshape(*batch, latents)
        if not covariance:
            return Latents(mean, None)
        return Latents(mean, self.widening**2 * self.latent.covariance(features).reshape(*batch, latents, latents))

    def predicted(
        self, q: Float[Tensor, "n nv"], v: Float[Tensor, "n nv"], u: Float[Tensor, "n nv"], covariance: bool
    ) -> PredictedForces:
        """What `Predictor.forces` documents."""
        dynamics = self.dynamics(q, v, u)
        found = components_of(self.prior, dynamics, self.latents(dynamics, covariance), self.known)
        parts = {name: part.joint_force for name, part in found.items()}
        return PredictedForces(found.total, found.multiplier, found.contact_force, parts)
