"""Where physics and Gaussian processes meet: from states and a prior to (m, W), features, start values and NLL."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.inference import LatentKernels, LatentPosterior, negative_log_likelihood
from forcegp.mechanics import ConstrainedDynamics, MechanicalSystem
from forcegp.models.noise import ACCELERATION, FORCE, Noise
from forcegp.priors import ForcePrior

Mean = Literal["analytical", "zero"]
INERTIALS = "inertials."
RESIDUAL_FLOOR = 1e-6
"""Smallest start variance of a latent as a fraction of the largest: a latent that the start residual does not
excite can still grow.
"""


@dataclass(frozen=True, eq=False)
class TrainingData:
    """States and measured accelerations (N, nv), float64."""

    q: Float[Tensor, "N nv"]
    v: Float[Tensor, "N nv"]
    u: Float[Tensor, "N nv"]
    a: Float[Tensor, "N nv"]


@dataclass(frozen=True, eq=False)
class Standardization:
    """Shift and scale of each latent's features, from the training points; constant features keep scale 1."""

    shift: tuple[Float[Tensor, "_"], ...]
    scale: tuple[Float[Tensor, "_"], ...]

    @classmethod
    def of(cls, features: Sequence[Float[Tensor, "N _"]]) -> Standardization:
        """Mean and standard deviation over the points."""
        shift = tuple(z.mean(0) for z in features)
        spread = [z.std(0, correction=0) for z in features]
        # below rounding of the values themselves a feature counts as constant
        scale = tuple(
            torch.where(std > 1e-12 * (1.0 + mean.abs()), std, torch.ones_like(std))
            for std, mean in zip(spread, shift, strict=True)
        )
        return cls(shift, scale)

    def __call__(self, features: Sequence[Float[Tensor, "*batch _"]]) -> list[Float[Tensor, "*batch _"]]:
        """Standardised features."""
        return [(z - m) / s for z, m, s in zip(features, self.shift, self.scale, strict=True)]


@dataclass(frozen=True, eq=False)
class MarginalLikelihood:
    """-log p(a | q, v, u, parameters) of one model on one training set, as a function of unconstrained parameters.

    Parameters by name: those of the kernels, `noise.log_acceleration` (nv,), optionally `noise.log_force` (nv,), and
    optionally `inertials.<link>` (10,) log-Cholesky parameters of links. All of them receive gradients in one backward
    pass.
    """

    system: MechanicalSystem
    prior: ForcePrior
    mean: Mean
    training: TrainingData

    def dynamics(self, parameters: Mapping[str, Tensor] | None = None) -> ConstrainedDynamics:
        """The constrained dynamics of the training states, at the inertial parameters among `parameters`."""
        inertials = inertials_of(parameters or {})
        if not inertials and not self._known_forces_are_learned:
            return self._nominal_dynamics
        return self.system.dynamics(self.training.q, self.training.v, self.training.u, inertials)

    @property
    def _known_forces_are_learned(self) -> bool:
        """Whether a tensor inside a known force wants a gradient; then nothing that depends on it may be kept."""
        forces = self.system.known_forces
        values = [getattr(force, name) for force in forces for name in force.per_joint]
        return any(isinstance(value, Tensor) and value.requires_grad for value in values)

    @cached_property
    def _nominal_dynamics(self) -> ConstrainedDynamics:
        with torch.no_grad():
            return self.system.dynamics(self.training.q, self.training.v, self.training.u)

    @cached_property
    def standardization(self) -> Standardization:
        """From the features of the training states, at the nominal inertial parameters."""
        return Standardization.of(self.prior.features(self._nominal_dynamics))

    @cached_property
    def _nominal_features(self) -> list[Tensor]:
        return self.standardization(self.prior.features(self._nominal_dynamics))

    @cached_property
    def _nominal_mixing(self) -> Tensor:
        return self._nominal_dynamics.H @ self.prior.mixing(self._nominal_dynamics)

    def terms(self, parameters: Mapping[str, Tensor]) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
        """Standardised features, W (N, nv, C), residual a - m (N, nv) and the noise, at `parameters`."""
        dynamics = self.dynamics(parameters)
        offset = dynamics.acceleration_map(known=self.mean == "analytical").offset
        noise = Noise.covariance(parameters, dynamics.H)
        if dynamics is self._nominal_dynamics:
            return self._nominal_features, self._nominal_mixing, self.training.a - offset, noise
        features = self.standardization(self.prior.features(dynamics))
        return features, dynamics.H @ self.prior.mixing(dynamics), self.training.a - offset, noise

    def kernels(self) -> LatentKernels:
        """Kernels with moment-based start values.

        Each latent starts with the variance of its least-squares estimate W^+ (a - m), the pseudo-inverse force
        residual.
        """
        offset = self._nominal_dynamics.acceleration_map(known=self.mean == "analytical").offset
        W = self._nominal_mixing
        estimate = (torch.linalg.pinv(W, rtol=1e-8) @ (self.training.a - offset)[..., None])[..., 0]
        variances = estimate.square().mean(0)
        largest = float(variances.max()) if variances.numel() else 0.0
        if variances.numel() and not largest > 0.0:
            raise InvalidInput(
                "the accelerations equal the mean exactly, so no unknown force can be learned; check that a was "
                "measured and not computed from "
                "the model itself"
            )
        variances = variances.clamp_min(RESIDUAL_FLOOR * largest)
        return LatentKernels(self.prior.kernels(tuple(z.shape[-1] for z in self._nominal_features), variances))

    def __call__(self, kernels: LatentKernels, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """The negative log marginal likelihood, exact and differentiable in every parameter.

        Raises InvalidInput for a parameter of a name that means nothing here.
        """
        known = {*kernels.initial_parameters(), ACCELERATION, FORCE}
        unknown = next((name for name in parameters if name not in known and not name.startswith(INERTIALS)), None)
        if unknown is not None:
            raise InvalidInput(f"no parameter {unknown!r}; there are {', '.join(sorted(known))} and {INERTIALS}<link>")
        features, W, residual, noise = self.terms(parameters)
        return negative_log_likelihood(W, residual, noise, kernels.matrices(parameters, features))

    def condition(self, kernels: LatentKernels, parameters: Mapping[str, Tensor]) -> LatentPosterior:
        """The posterior of the latent functions at fixed parameters."""
        with torch.no_grad():
            features, W, residual, noise = self.terms(parameters)
            return LatentPosterior.condition(kernels.at(parameters), features, W, residual, noise)


def inertials_of(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Link name -> log-Cholesky parameters, from the entries `inertials.<link>`."""
    return {name[len(INERTIALS) :]: value for name, value in parameters.items() if name.startswith(INERTIALS)}
