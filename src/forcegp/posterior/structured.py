"""`StructuredPosterior`: a fitted structured model as a value that predicts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.data import Dataset
from forcegp.data.dataset import require_rows
from forcegp.errors import InvalidInput, require_known, require_type, usable_arguments
from forcegp.evidence.likelihood import MarginalLikelihood
from forcegp.evidence.training_data import TrainingData, second_moments, shrunk
from forcegp.forces import Force, JointAccelerations, JointForces
from forcegp.inference import (
    Engine,
    Exact,
    InducingPosterior,
    LatentKernels,
    LatentPosterior,
    LeaveOut,
    OptimizationResult,
    exact,
    leave_blocks_out,
)
from forcegp.inference.cholesky_update import rows_to_keep
from forcegp.inference.pathwise import draw_functions, mean_function
from forcegp.inference.prepared_kernels import CompressedCovariance
from forcegp.inference.threads import blas_threads
from forcegp.mechanics import AffineMap, Baumgarte, ConstrainedDynamics
from forcegp.model import Model
from forcegp.noise import ACCELERATION, FORCE, Noise
from forcegp.posterior.components import Components, Curve, components_of
from forcegp.posterior.estimates import Estimates
from forcegp.posterior.fused_rollouts import FusedLoop
from forcegp.posterior.motion_intervals import MotionIntervals
from forcegp.posterior.observed_wrench import rows_of_own_system
from forcegp.posterior.posterior import Array, Posterior
from forcegp.posterior.prediction import Gaussian, Inputs, Positions, Prediction, Rows
from forcegp.posterior.predictor import Predictor
from forcegp.posterior.predictor_code import PredictorCode
from forcegp.posterior.predictor_preparation import PredictorPhysics, prepared_predictor, rows_for
from forcegp.posterior.rollout import AccelerationFunction, AccelerationModel
from forcegp.posterior.update import Keep, learn_and_forget, learn_more_rows
from forcegp.robots.arguments import real_tensor


@dataclass(frozen=True, eq=False, repr=False)
class StructuredPosterior(Posterior):
    """a = M^-1 Q_b + H (Q_K + B f) + noise, f ~ GP (Rath et al. 2021, eqs. 6-7), conditioned on a log by `forcegp.fit`.

    `result` holds the history of the optimisation, `settings` the resolved configuration of the fit (plain JSON
    values).
    """

    trained: Model
    likelihood: MarginalLikelihood
    hyperparameters: Mapping[str, Tensor]
    result: OptimizationResult
    settings: Mapping[str, Any]
    latent: LatentPosterior
    """The posterior of the latent functions."""
    engine: Engine
    """What computed `latent`."""
    estimates: Estimates = field(default_factory=Estimates)
    target: Model | None = None

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
    ) -> "StructuredPosterior":
        likelihood = MarginalLikelihood(model, replace(training, correlated_rows=settings.get("correlated_rows", 1.0)))
        engine = engine or Exact()
        # now: a failure belongs to the fit, not to the first prediction
        latent = likelihood.condition(likelihood.kernels, hyperparameters, engine, start=solution)
        found = dict(hyperparameters), result, dict(settings), latent, engine, estimates or Estimates()
        return cls(model, likelihood, *found)

    @staticmethod
    @override
    def parameter_shapes(model: Model, training: TrainingData) -> dict[str, tuple[int, ...]]:
        return MarginalLikelihood(model, training).parameter_shapes

    @property
    def kernels(self) -> LatentKernels:
        """Of the latent functions, at their start values."""
        return self.likelihood.kernels

    @property
    @override
    def solution(self) -> Tensor | None:
        return self.engine.solution(self.latent)

    @property
    @override
    def training(self) -> TrainingData:
        return self.likelihood.training

    @property
    @override
    def description(self) -> str:
        forces = self.trained.unknown
        mean = "zero mean" if self.carries_known_forces else "analytical mean"
        if not forces.terms:
            return "identified model" if self.estimates else "analytical model"
        if isinstance(forces.terms[0], JointAccelerations):
            return f"unconstrained accelerations, {mean}"
        names = list(forces.term_names)
        shown = "" if names == [JointForces().title] else f"{' + '.join(names)}, "
        return f"{shown}{mean}"

    @property
    @override
    def carries_known_forces(self) -> bool:
        return self.trained.carries_known_forces

    @override
    def dynamics(
        self, q: Float[Tensor, "*batch nq"], v: Float[Tensor, "*batch nv"], u: Float[Tensor, "*batch nu"]
    ) -> ConstrainedDynamics:
        return self.model.dynamics(q, v, u)

    @override
    def predict_rows(self, q: Positions, v: Rows, u: Inputs, covariance: bool) -> Prediction:
        dynamics = self.dynamics(q, v, u)
        B = self.trained.unknown.direction(dynamics)
        latents = self.latents(dynamics, covariance)

        def through(affine: AffineMap) -> Gaussian:
            return latents.through(affine.matrix @ B, affine.offset)

        acceleration, torque_noise = self.acceleration_map(dynamics)
        predicted = through(acceleration)
        noise, spread = dict(self.hyperparameters), predicted.covariance
        if torque_noise is not None:  # it counts as unknown, not as noise of the measured acceleration
            del noise[FORCE]
            spread = None if spread is None else spread + torque_noise
        return Prediction(
            predicted.mean,
            spread,
            multiplier=through(dynamics.multiplier_map()),
            contact_force=through(dynamics.contact_force_map()),
            unknown_force=latents.through(B),
            noise_covariance=_noise_covariance(noise, dynamics),
        )

    def acceleration_map(self, dynamics: ConstrainedDynamics) -> tuple[AffineMap, Tensor | None]:
        """Acceleration as a function of the unknown force, and what u's own noise leaves open; None for exact u."""
        affine = dynamics.acceleration_map()
        noise = self.trained.noise
        if noise is None or not noise.measured_torque:
            return affine, None
        return shrunk(affine, dynamics.H, self.hyperparameters[FORCE].exp(), second_moments(self.training.a))

    def latents(self, dynamics: ConstrainedDynamics, covariance: bool) -> Gaussian:
        """All processes at a batch of states: mean (..., C), and their joint covariance (..., C, C) where asked for."""
        batch = dynamics.state.q.shape[:-1]
        given = self.likelihood.standardization(self.trained.unknown.features(dynamics))
        features = [z.reshape(batch.numel(), z.shape[-1]) for z in given]
        latents = len(features)
        if not latents:
            nothing = dynamics.state.q.new_zeros(*batch, 0, 0)
            return Gaussian(nothing.flatten(-2), nothing if covariance else None)
        mean, spread = self.latent.mean(features).reshape(*batch, latents), None
        if covariance:
            spread = self.widening**2 * self.latent.covariance(features).reshape(*batch, latents, latents)
        return Gaussian(mean, spread)

    @property
    def widening(self) -> float:
        """How many times as wide intervals are as those of `latent`, whose hyper-parameters count as known.

        `structured/widening.py` says why and how much; `posterior.with_settings(widening=1.0)` does without.
        """
        return float(self.settings.get("widening", 1.0))

    @override
    def predictor(
        self, *, covariance: str = "auto", tolerance: float = 0.01, largest_rank: int = 1536, compile: bool = True
    ) -> Predictor:
        self._require_commanded_torques()
        how = {"covariance": covariance, "tolerance": tolerance, "largest_rank": largest_rank, "compile": compile}
        physics, training = self._physics(self.model), rows_for(self.training, self.trained, self.model)
        return replace(prepared_predictor(self.latent, self.widening, training, physics, **how), posterior=self)

    @override
    def components(self, q: Array, v: Array, u: Array, *, covariance: bool = True) -> Components:
        """Every force by itself: each term of the prior, their sum and the normal forces, from this one fit.

        States as for `predict`, as many as fit into memory at once. `components(q, v, u)["joint-friction"].joint_force`
        is a `Gaussian` (..., nv) in Nm or N. Raises InvalidInput for wrong shapes or values that are not finite.
        """
        require_type("covariance", covariance, bool)
        states, batch = self.checked_states(q, v, u)
        dynamics = self.dynamics(*(x.reshape(*batch, x.shape[-1]) for x in states))
        latents = self.latents(dynamics, covariance)
        return components_of(self.trained.unknown, dynamics, latents)

    @override
    @usable_arguments("curve")
    def curve(self, latent: str, features: Array | None = None, *, points: int = 200) -> Curve:
        """One process of the prior over its features: a friction curve, for example.

        Parameters
        ----------
        latent: its name, one of `latent_names`.
        features: (n, d), or (n,) where the process has one feature, in the units of `prior.feature_names`. None takes
            `points` values over the range that the training data visited, for processes of one feature; a constant,
            which has none, is one value.

        Raises InvalidInput for another name, wrong shapes, and None for processes of several features.
        """
        names = self.latent_names
        require_known("latent", latent, "this model", names)
        index = names.index(latent)
        prior, robot = self.trained.unknown, self.trained.robot
        with torch.no_grad():
            given = prior.features(self.likelihood.dynamics)[index]
            visited = torch.stack([given.amin(0), given.amax(0)]) if given.shape[-1] else given[:2]
            z = _curve_features(latent, features, visited, points)
            standardization = self.likelihood.standardization
            shift, scale = (part[index] for part in (standardization.shift, standardization.scale))
            mean, variance = self.latent.one(index, (z - shift) / scale)
        labels = prior.feature_names(robot)
        plain = tuple(f"feature {k}" for k in range(z.shape[-1]))
        return Curve(
            latent,
            prior.latent_units(robot)[index],
            plain if labels is None else labels[index],
            z,
            mean,
            self.widening * variance.clamp_min(0.0).sqrt(),
            visited,
        )

    @property
    def latent_names(self) -> tuple[str, ...]:
        """The processes that the prior is made of."""
        return self.trained.unknown.latent_names(self.trained.robot)

    @override
    def with_model(self, model: Model) -> "StructuredPosterior":
        """The same unknown forces in another model (robot, contacts, laws, stabilisation) with the same joints.

        Those of contacts that it lacks are zero there, and its `forces` do not list them.

        Raises InvalidInput for other joints, and, without `RigidBodies`, for another robot: the processes hold
        the weight and inertia of the one that they were trained on; UnknownFrame where a force acts on a frame that the
        robot lacks.
        """
        require_type("model", model, Model)
        trained = self.trained
        if model.robot.joint_names != trained.robot.joint_names:
            raise InvalidInput(
                f"the model was trained on joints {', '.join(trained.robot.joint_names)}; the other robot has "
                f"{', '.join(model.robot.joint_names)}. Forces can move to robots with the same joints only."
            )
        if self.carries_known_forces and not model.robot.tree.equals(trained.robot.tree):
            raise InvalidInput(
                "the mean has no rigid bodies, so the processes hold gravity and inertia of the robot that it was "
                "trained on and cannot move to another; fit a model with RigidBodies()."
            )
        # asks for the frames, at a state where a surface is likely to have a normal
        q, v, u = (x[:1].to(model.robot.device) for x in (self.training.q, self.training.v, self.training.u))
        u = u.new_zeros(1, model.sizes[2]) if len(u[0]) != model.sizes[2] else u
        self.trained.unknown.direction(model.dynamics(q, v, u))
        # the training rows are always conditioned in their own system: nothing is factorised again, no number changes
        # widths of intervals of motions were found in the system before
        kept = {name: value for name, value in self.settings.items() if name != "motion_intervals"}
        there = (force for force in trained.unknown_forces if _has_its_place(force, model))
        model = replace(model, forces=(*model.laws, *there), noise=trained.noise)
        return replace(self, target=model, settings=kept)

    @override
    def update(
        self,
        rows: Dataset,
        budget: int | None = None,
        *,
        keep: Keep = rows_to_keep,
        horizon: float | Mapping[str, float] | None = None,
    ) -> "StructuredPosterior":
        """As `Posterior.update`; `keep` chooses the rows that stay.

        With a `horizon` in s, forces change with time: kernels become k(z, z') exp(-|t - t'| / horizon), one for all or
        {term: its own}, and the posterior, through inducing points, is that at the last row
        (docs/how-to/incremental.md). Rows of a call count as simultaneous, those of the fit as at its first row. Raises
        InvalidInput where time goes back.
        """
        example = ", for example Dataset(q=q, v=v, u=u, a=a, time=t, model=posterior.model)"
        require_rows("rows", rows, self.model.robot.joint_names, "the model", example)
        own, rows = replace(self, target=None), rows_of_own_system(self, rows)
        if horizon is None:
            return replace(learn_more_rows(own, rows, budget, keep), target=self.target)
        return replace(learn_and_forget(own, rows, budget, horizon), target=self.target)

    @property
    @override
    def motion_intervals(self) -> MotionIntervals | None:
        stored = self.settings.get("motion_intervals")
        found = None if stored is None else MotionIntervals.from_dict(stored)
        # widths of motions that an observer's columns were part of are not those of motions without
        return None if found is None or found.inputs not in ((), self.model.inputs) else found

    @override
    def accelerations(self, baumgarte: Baumgarte | None) -> AccelerationModel:
        if baumgarte is not None and not self.model.contacts:
            raise InvalidInput("baumgarte was given, but the model has no contacts; give baumgarte=None.")
        model = replace(self.model, baumgarte=baumgarte)
        prior, standardize = self.trained.unknown, self.likelihood.standardization

        def through(functions: Callable[[list[Tensor]], Tensor]) -> AccelerationFunction:
            def acceleration(q: Tensor, v: Tensor, u: Tensor) -> Tensor:
                dynamics = model.dynamics(q, v, u)
                affine, _ = self.acceleration_map(dynamics)
                mixing = prior.direction(dynamics)
                if not mixing.shape[-1]:
                    return affine.offset
                latents = functions(standardize(prior.features(dynamics)))
                return affine((mixing @ latents[..., None])[..., 0])

            return acceleration

        def mean() -> AccelerationFunction:
            return through(mean_function(self.latent))

        def sampled(samples: int, seed: int) -> AccelerationFunction:
            if not len(self.kernels.kernels):  # no unknown force: all functions are the same
                return mean()
            return through(draw_functions(self.latent, samples, seed, self.widening))

        def compiled(integrator: str, samples: int, seed: int) -> list[FusedLoop] | None:
            return self.code(model).loops(integrator, self.latent, samples, seed)

        return AccelerationModel(model, baumgarte, mean, sampled, compiled)

    def code(self, model: Model | None = None, compressed: CompressedCovariance | None = None) -> PredictorCode:
        """The mean as a graph, from which programs are written, in another system if one is given.

        Raises InvalidInput for operations that no graph holds, models on another device, and noisy torques.
        """
        model = self.model if model is None else model
        self._require_commanded_torques()
        rows = rows_for(self.training, self.trained, model)
        example = [x[:1] for x in (rows.q, rows.v, rows.u)]
        return PredictorCode.of(
            self._physics(model), example, model.robot.space, self.latent, compressed, self.widening
        )

    def _require_commanded_torques(self) -> None:
        noise = self.trained.noise
        if noise is not None and noise.measured_torque:
            raise InvalidInput(
                "a predictor is for commanded torques, and in this model u comes from a noisy sensor; call "
                "predict, or fit with Noise(..., measured_torque=False)."
            )

    def _physics(self, model: Model) -> PredictorPhysics:
        return PredictorPhysics(model, self.trained.unknown, self.likelihood.standardization)

    @override
    def leave_out(self, blocks: Sequence[Sequence[int]] | None = None) -> LeaveOut:
        with torch.no_grad(), blas_threads(self.training.q.numel()):
            *_, noise = self.likelihood.terms(self.hyperparameters)
            return leave_blocks_out(exact(self.latent, "leaving rows out").system, noise, blocks)

    @cached_property
    def negative_log_likelihood(self) -> float:
        """-log p(a | q, v, u) of the training data at the fitted parameters, in nats, without any hyperprior.

        With inducing points its upper bound.
        """
        with torch.no_grad():
            if isinstance(self.latent, InducingPosterior):
                return float(self.likelihood.bound(self.kernels, self.hyperparameters, self.latent.features))
            return float(self.likelihood(self.kernels, self.hyperparameters))

    @property
    @override
    def noise_std(self) -> Float[Tensor, "nv"]:
        return self.hyperparameters[ACCELERATION].exp()


def _has_its_place(force: Force, model: Model) -> bool:
    """Whether a model has what a force acts at; without its contact a force is zero."""
    try:
        force.check(model.robot, model.contacts)
    except InvalidInput:
        return False
    return True


def _noise_covariance(parameters: Mapping[str, Tensor], dynamics: ConstrainedDynamics) -> Tensor:
    noise = Noise.covariance(parameters, dynamics.H)
    return torch.diag_embed(noise).expand_as(dynamics.H) if noise.dim() == 2 else noise


def _curve_features(latent: str, given: Array | None, visited: Tensor, points: int) -> Tensor:
    """Features (n, d) of a curve, checked."""
    count = visited.shape[-1]
    if given is None:
        if not count:
            return visited[:1]  # a constant has one value
        if count != 1:
            raise InvalidInput(f"{latent!r} is a function of {count} features; give features (n, {count})")
        if points < 1:
            raise InvalidInput(f"a curve of points={points} was asked for; give 1 or more")
        steps = torch.linspace(0.0, 1.0, points, dtype=torch.float64, device=visited.device)
        return visited[0] + steps[:, None] * (visited[1] - visited[0])
    z = real_tensor(f"features of {latent!r}", given, visited.device)
    z = z[:, None] if z.dim() == 1 and count == 1 else z
    if z.dim() != 2 or z.shape[-1] != count or not bool(torch.isfinite(z).all()):
        raise InvalidInput(f"features of {latent!r} have shape {tuple(z.shape)}; give finite numbers (n, {count})")
    return z
