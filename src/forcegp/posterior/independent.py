"""`IndependentPosterior`: one Gaussian process per joint acceleration, conditioned on data."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.evidence.training_data import RESIDUAL_FLOOR, Standardization, TrainingData
from forcegp.forces.unknown import kernels_of
from forcegp.inference import (
    Engine,
    ExactPosterior,
    LatentKernels,
    LeaveOut,
    OptimizationResult,
    Terms,
    leave_blocks_out,
    negative_log_likelihood,
)
from forcegp.inference.pathwise import draw_functions, mean_function
from forcegp.inference.threads import blas_threads
from forcegp.mechanics import Baumgarte
from forcegp.model import Model
from forcegp.noise import ACCELERATION, Noise
from forcegp.posterior.estimates import Estimates
from forcegp.posterior.posterior import Posterior
from forcegp.posterior.prediction import Inputs, Positions, Prediction, Rows
from forcegp.posterior.rollout import AccelerationFunction, AccelerationModel


def joint_part(parameters: Mapping[str, Tensor], joint: int) -> dict[str, Tensor]:
    """Of the parameters of all joints those of one, under the names of a model with that joint alone."""
    prefix = f"kernels.{joint}."
    part = {f"kernels.0.{name[len(prefix) :]}": value for name, value in parameters.items() if name.startswith(prefix)}
    if ACCELERATION in parameters:
        part[ACCELERATION] = parameters[ACCELERATION][joint : joint + 1]
    return part


def one_joint(kernels: LatentKernels, joint: int) -> LatentKernels:
    """The kernel of one joint alone."""
    return LatentKernels([list(kernels)[joint]])


@dataclass(frozen=True, eq=False)
class IndependentLikelihood:
    """-log p(a_j | q, v, u) of every joint on one training set: exact inference with W = 1 and N rows."""

    inputs: tuple[str, ...]
    training: TrainingData

    @cached_property
    def standardization(self) -> Standardization:
        """From the inputs of the training states."""
        return Standardization.of([self._columns(self.training.q, self.training.v, self.training.u)])

    def features(self, q: Positions, v: Rows, u: Inputs) -> Float[Tensor, "rows d"]:
        """Standardised inputs, the same for every joint."""
        return self.standardization([self._columns(q, v, u)])[0]

    def kernels(self) -> LatentKernels:
        """One per joint; variances start at mean squares. Raises InvalidInput if all accelerations are zero."""
        variances = self.training.a.square().mean(0)
        largest = float(variances.max())
        if not largest > 0.0:
            raise InvalidInput("all accelerations are zero, so there is nothing to learn; check that a was measured.")
        dimension = self._training_features.shape[-1]
        floored = variances.clamp_min(RESIDUAL_FLOOR * largest)
        kernels = kernels_of("squared-exponential", (dimension,) * len(variances), floored)
        return LatentKernels(kernels).to(floored.device)

    def __call__(self, joint: int, kernels: LatentKernels, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """The negative log marginal likelihood of one joint, at parameters named as by `joint_part`."""
        matrices = kernels.matrices(parameters, [self._training_features])
        terms = self.terms(joint, parameters)
        return negative_log_likelihood(terms.W, terms.residual, terms.noise, matrices)

    def condition(self, joint: int, kernels: LatentKernels, parameters: Mapping[str, Tensor]) -> ExactPosterior:
        """The posterior of one joint's function at fixed parameters."""
        return ExactPosterior.condition(kernels.at(parameters), self.terms(joint, parameters))

    @cached_property
    def _training_features(self) -> Tensor:
        return self.features(self.training.q, self.training.v, self.training.u)

    def terms(self, joint: int, parameters: Mapping[str, Tensor]) -> Terms:
        """Of one joint, with mixing W = 1 and a noise variance."""
        target = self.training.a[:, joint : joint + 1]
        variance = (2.0 * parameters[ACCELERATION]).exp()[None]
        factors = self.training.noise_factors
        if factors is not None:
            variance = variance * factors[:, joint : joint + 1].square()
        return Terms([self._training_features], torch.ones_like(target)[..., None], target, variance)

    def _columns(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        states = {"q": q, "v": v, "u": u}
        return torch.cat([states[name] for name in self.inputs], dim=-1)


@dataclass(frozen=True, eq=False)
class JointLikelihood:
    """That of one joint, as a search calls it."""

    whole: IndependentLikelihood
    joint: int

    @property
    def training(self) -> TrainingData:
        """Of all joints."""
        return self.whole.training

    def __call__(self, kernels: LatentKernels, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """In nats."""
        return self.whole(self.joint, kernels, parameters)


@dataclass(frozen=True, eq=False, repr=False)
class IndependentPosterior(Posterior):
    """A model of `IndependentAccelerations` conditioned on training data; made by `forcegp.fit` or `load_posterior`.

    Predictions have a diagonal covariance and no forces. Hyper-parameters have the names that other models with
    one kernel per joint give them, so either can start the search of the other.
    """

    trained: Model
    likelihood: IndependentLikelihood
    hyperparameters: Mapping[str, Tensor]
    result: OptimizationResult
    settings: Mapping[str, Any]
    latents: tuple[ExactPosterior, ...]
    """The posterior of every joint's function."""
    predicts_forces: ClassVar[bool] = False
    estimates: Estimates = field(default_factory=Estimates)

    @classmethod
    @override
    def conditioned(
        cls,
        model: Model,
        training: TrainingData,
        hyperparameters: Mapping[str, Tensor],
        result: OptimizationResult,
        settings: Mapping[str, Any],
        engine: Engine | None = None,
        solution: Tensor | None = None,
        estimates: Estimates | None = None,
    ) -> "IndependentPosterior":
        likelihood = IndependentLikelihood(model.unknown_forces[0].inputs, training)
        kernels = likelihood.kernels()
        latents = tuple(  # now: a failure belongs to the fit, not to the first prediction
            likelihood.condition(joint, one_joint(kernels, joint), joint_part(hyperparameters, joint))
            for joint in range(model.robot.nv)
        )
        return cls(model, likelihood, dict(hyperparameters), result, dict(settings), latents)

    @staticmethod
    @override
    def parameter_shapes(model: Model, training: TrainingData) -> dict[str, tuple[int, ...]]:
        kernels = IndependentLikelihood(model.unknown_forces[0].inputs, training).kernels()
        named = kernels.initial_parameters() | (model.noise or Noise()).parameters(model.robot.nv)
        return {name: tuple(value.shape) for name, value in named.items()}

    @property
    @override
    def training(self) -> TrainingData:
        return self.likelihood.training

    @property
    @override
    def description(self) -> str:
        return "independent GP"

    @override
    def accelerations(self, baumgarte: Baumgarte | None) -> AccelerationModel:
        base = super().accelerations(baumgarte)  # refuses a stabilisation, for no constraint is known

        def through(functions: Sequence[Callable[[list[Tensor]], Tensor]]) -> AccelerationFunction:
            def acceleration(q: Tensor, v: Tensor, u: Tensor) -> Tensor:
                z = self.likelihood.features(*(x.reshape(q.shape[:-1].numel(), x.shape[-1]) for x in (q, v, u)))
                points = [z.reshape(*q.shape[:-1], -1)]
                return torch.cat([function(points) for function in functions], dim=-1)

            return acceleration

        def sampled(samples: int, seed: int) -> AccelerationFunction:
            seeds = np.random.SeedSequence(seed).generate_state(len(self.latents))  # joints are independent
            each = zip(self.latents, seeds, strict=True)
            return through([draw_functions(latent, samples, int(own)) for latent, own in each])

        return AccelerationModel(base.model, None, lambda: through([*map(mean_function, self.latents)]), sampled)

    @property
    @override
    def noise_std(self) -> Float[Tensor, "nv"]:
        return self.hyperparameters[ACCELERATION].exp()

    @cached_property
    @override
    def negative_log_likelihood(self) -> float:
        kernels = self.likelihood.kernels()
        with torch.no_grad():
            return sum(
                float(self.likelihood(joint, one_joint(kernels, joint), joint_part(self.hyperparameters, joint)))
                for joint in range(self.model.robot.nv)
            )

    @override
    def leave_out(self, blocks: Sequence[Sequence[int]] | None = None) -> LeaveOut:
        noises = [self.likelihood.terms(j, joint_part(self.hyperparameters, j))[-1] for j in range(len(self.latents))]
        with blas_threads(len(self.training.q)):
            each = zip(self.latents, noises, strict=True)
            return LeaveOut.of_independent_outputs([leave_blocks_out(x.system, noise, blocks) for x, noise in each])

    @override
    def predict_rows(self, q: Positions, v: Rows, u: Inputs, covariance: bool) -> Prediction:
        z = [self.likelihood.features(q, v, u)]
        mean = torch.cat([latent.mean(z) for latent in self.latents], dim=-1)
        variance = None
        if covariance:
            variance = torch.cat([latent.covariance(z)[..., 0] for latent in self.latents], dim=-1)
        return Prediction.of_accelerations(mean, variance, self.noise_std.square().expand_as(mean))
