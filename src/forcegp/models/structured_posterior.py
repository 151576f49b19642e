"""`StructuredPosterior`: what a fitted structured model knows, as a value that predicts, and saves and loads itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.inference import LatentKernels, LatentPosterior, OptimizationResult
from forcegp.mechanics import AffineMap, Baumgarte, ConstrainedDynamics
from forcegp.models.accelerations import AccelerationModel, StructuredAccelerations
from forcegp.models.identification import Identification
from forcegp.models.marginal_likelihood import MarginalLikelihood, TrainingData, inertials_of
from forcegp.models.noise import ACCELERATION, Noise
from forcegp.models.physical_parameters import PHYSICAL
from forcegp.models.prediction import Gaussian, Prediction
from forcegp.models.protocol import Posterior
from forcegp.priors import JointAccelerations, NoForces

if TYPE_CHECKING:
    from forcegp.models.structured_gp import StructuredGP


@dataclass(frozen=True, eq=False)
class StructuredPosterior(Posterior):
    """A `StructuredGP` conditioned on training data; made by `StructuredGP.fit` or `load_posterior`.

    `result` holds the history of the optimisation, `settings` the resolved configuration of the fit (plain JSON
    values), `identification` what was learned of the system itself, after a fit with `learn` (not after loading).
    """

    model: StructuredGP
    likelihood: MarginalLikelihood
    kernels: LatentKernels
    parameters: Mapping[str, Tensor]
    result: OptimizationResult
    settings: Mapping[str, Any]
    identification: Identification | None = None

    @cached_property
    def latent(self) -> LatentPosterior:
        """The posterior of the latent functions."""
        return self.likelihood.condition(self.kernels, self.parameters)

    @property
    @override
    def training(self) -> TrainingData:
        return self.likelihood.training

    @property
    @override
    def description(self) -> str:
        if isinstance(self.model.prior, NoForces):
            return "analytical model"
        unconstrained = isinstance(self.model.prior, JointAccelerations)
        return f"{'unconstrained accelerations, ' if unconstrained else ''}{self.model.mean} mean"

    @property
    @override
    def carries_known_forces(self) -> bool:
        return self.model.mean == "zero"

    @override
    def dynamics(
        self, q: Float[Tensor, "*batch nv"], v: Float[Tensor, "*batch nv"], u: Float[Tensor, "*batch nv"]
    ) -> ConstrainedDynamics:
        return self.system.dynamics(q, v, u, inertials_of(self.parameters) or None)

    @override
    def predict_rows(
        self, q: Float[Tensor, "rows nv"], v: Float[Tensor, "rows nv"], u: Float[Tensor, "rows nv"], covariance: bool
    ) -> Prediction:
        dynamics = self.dynamics(q, v, u)
        known = self.model.mean == "analytical"
        features = self.likelihood.standardization(self.model.prior.features(dynamics))
        B = self.model.prior.mixing(dynamics)
        rows, latents = len(q), B.shape[-1]
        mean = self.latent.mean(features) if latents else q.new_zeros(rows, 0)
        cov = None
        if covariance:
            cov = self.latent.covariance(features) if latents else q.new_zeros(rows, 0, 0)

        def through(affine: AffineMap) -> Gaussian:
            W = affine.matrix @ B
            value = affine.offset + (W @ mean[..., None])[..., 0]
            return Gaussian(value, None if cov is None else _symmetric(W @ cov @ W.mT))

        acceleration = through(dynamics.acceleration_map(known))
        return Prediction(
            acceleration.mean,
            acceleration.covariance,
            multiplier=through(dynamics.multiplier_map(known)),
            contact_force=through(dynamics.contact_force_map(known)),
            unknown_force=through(_identity_map(dynamics)),
            noise_covariance=_noise_covariance(self.parameters, dynamics),
        )

    @override
    def accelerations(self, baumgarte: Baumgarte | None) -> AccelerationModel:
        return StructuredAccelerations(self, baumgarte)

    def at_iteration(self, iteration: int) -> StructuredPosterior:
        """The posterior as it was after that iteration of the search (0: the start), its system included.

        Raises InvalidInput unless the fit kept its iterates: with `learn`, or `OptimizerOptions(keep_iterates=True)`.
        """
        kept = self.result.iterates
        if not 0 <= iteration < len(kept):
            raise InvalidInput(
                f"iteration {iteration} was not kept; there are {len(kept)}, from 0. Fit with learn=..., or with "
                "options=OptimizerOptions(keep_iterates=True)"
            )
        point = {**self.parameters, **kept[iteration]}
        z = point.pop(PHYSICAL, None)
        model = self.model
        if z is not None and self.identification is not None:
            model = replace(model, system=self.identification.physical.system_at(z))
        return model.condition(self.likelihood.training, point, self.result, self.settings)

    @cached_property
    def negative_log_likelihood(self) -> float:
        """-log p(a | q, v, u) of the training data at the fitted parameters, in nats, without any hyperprior."""
        with torch.no_grad():
            return float(self.likelihood(self.kernels, self.parameters))

    @property
    @override
    def noise_std(self) -> Float[Tensor, "nv"]:
        return self.parameters[ACCELERATION].exp()


def _identity_map(dynamics: ConstrainedDynamics) -> AffineMap:
    nv = dynamics.state.u.shape[-1]
    identity = torch.eye(nv, dtype=dynamics.state.u.dtype, device=dynamics.state.u.device)
    return AffineMap(torch.zeros_like(dynamics.state.u), identity.expand_as(dynamics.H))


def _noise_covariance(parameters: Mapping[str, Tensor], dynamics: ConstrainedDynamics) -> Tensor:
    noise = Noise.covariance(parameters, dynamics.H)
    return torch.diag_embed(noise).expand_as(dynamics.H) if noise.dim() == 2 else noise


def _symmetric(matrix: Tensor) -> Tensor:
    return 0.5 * (matrix + matrix.mT)
