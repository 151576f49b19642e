"""`StructuredPosterior`: a fitted structured model as a value that predicts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.data import Dataset
from forcegp.data.dataset_arguments import require_rows
from forcegp.errors import InvalidInput, require_known, require_type, usable_arguments
from forcegp.inference import (
    Engine,
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
from forcegp.mechanics import AffineMap, Baumgarte, ConstrainedDynamics, MechanicalSystem
from forcegp.models.fused_rollouts import FusedLoop
from forcegp.models.identification.identification import Identification
from forcegp.models.identification.physical_parameters import PHYSICAL, inertials_of
from forcegp.models.motion_models import HORIZONS, MotionIntervals
from forcegp.models.observed_wrench import rows_of_own_system
from forcegp.models.prediction import Gaussian, Inputs, Positions, Prediction, Rows
from forcegp.models.predictor import Predictor
from forcegp.models.predictor_code import PredictorCode
from forcegp.models.protocol import Array, Posterior
from forcegp.models.rollout import AccelerationFunction, AccelerationModel
from forcegp.models.search import blas_threads
from forcegp.models.structured.components import Components, Curve, components_of, term_slices
from forcegp.models.structured.marginal_likelihood import MarginalLikelihood, StructuredModel
from forcegp.models.structured.motion_calibration import calibrate_motions
from forcegp.models.structured.motion_fit import refine_on_motions
from forcegp.models.structured.predictor_preparation import PredictorPhysics, prepared_predictor, rows_for
from forcegp.models.structured.update import Keep, learn_and_forget, learn_more_rows
from forcegp.models.training_data import ACCELERATION, FORCE, Noise, TrainingData, second_moments, shrunk
from forcegp.priors import JointAccelerations, JointForces, NoForces
from forcegp.robots.arguments import real_tensor


@dataclass(frozen=True, eq=False, repr=False)
class StructuredPosterior(Posterior):
    """A `StructuredGP` conditioned on training data; made by `StructuredGP.fit` or `load_posterior`.

    `result` holds the history of the optimisation, `settings` the resolved configuration of the fit (plain JSON
    values), `identification` what was learned of the system itself, after a fit with `learn` (not after loading).
    `target` is the system that predictions are for, where it is not the one that the model was trained on
    (`with_contacts`, `with_robot`).
    """

    model: StructuredModel
    likelihood: MarginalLikelihood
    kernels: LatentKernels
    parameters: Mapping[str, Tensor]
    result: OptimizationResult
    settings: Mapping[str, Any]
    latent: LatentPosterior
    """The posterior of the latent functions."""
    engine: Engine
    """What computed `latent`."""
    identification: Identification | None = None
    target: MechanicalSystem | None = None

    @property
    @override
    def solution(self) -> Tensor | None:
        return self.engine.solution(self.latent)

    @property
    @override
    def system(self) -> MechanicalSystem:
        return self.model.system if self.target is None else self.target

    @property
    @override
    def training(self) -> TrainingData:
        return self.likelihood.training

    @property
    @override
    def description(self) -> str:
        prior = self.model.prior
        if isinstance(prior, NoForces):
            return "analytical model"
        if isinstance(prior, JointAccelerations):
            return f"unconstrained accelerations, {self.model.mean} mean"
        names = [name for name, *_ in term_slices(prior, self.model.system.robot)]
        shown = "" if names == [JointForces().title] else f"{' + '.join(names)}, "
        return f"{shown}{self.model.mean} mean"

    @property
    @override
    def carries_known_forces(self) -> bool:
        return self.model.mean == "zero"

    @override
    def dynamics(
        self, q: Float[Tensor, "*batch nq"], v: Float[Tensor, "*batch nv"], u: Float[Tensor, "*batch nu"]
    ) -> ConstrainedDynamics:
        return self.system.dynamics(q, v, u, inertials_of(self.parameters) or None)

    @override
    def predict_rows(self, q: Positions, v: Rows, u: Inputs, covariance: bool) -> Prediction:
        dynamics = self.dynamics(q, v, u)
        known = self.model.mean == "analytical"
        B = self.model.prior.mixing(dynamics)
        latents = self.latents(dynamics, covariance)

        def through(affine: AffineMap) -> Gaussian:
            return latents.through(affine.matrix @ B, affine.offset)

        acceleration, torque_noise = self.acceleration_map(dynamics)
        predicted = through(acceleration)
        noise, spread = dict(self.parameters), predicted.covariance
        if torque_noise is not None:  # it counts as unknown, not as noise of the measured acceleration
            del noise[FORCE]
            spread = None if spread is None else spread + torque_noise
        return Prediction(
            predicted.mean,
            spread,
            multiplier=through(dynamics.multiplier_map(known)),
            contact_force=through(dynamics.contact_force_map(known)),
            unknown_force=latents.through(B),
            noise_covariance=_noise_covariance(noise, dynamics),
        )

    def acceleration_map(self, dynamics: ConstrainedDynamics) -> tuple[AffineMap, Tensor | None]:
        """Acceleration as a function of the unknown force, and what u's own noise leaves open; None for exact u."""
        affine = dynamics.acceleration_map(self.model.mean == "analytical")
        noise = self.model.noise
        if noise is None or not noise.measured_torque:
            return affine, None
        return shrunk(affine, dynamics.H, self.parameters[FORCE].exp(), second_moments(self.training.a))

    def latents(self, dynamics: ConstrainedDynamics, covariance: bool) -> Gaussian:
        """All processes at a batch of states: mean (..., C), and their joint covariance (..., C, C) where asked for."""
        batch = dynamics.state.q.shape[:-1]
        given = self.likelihood.standardization(self.model.prior.features(dynamics))
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
        physics, training = self._physics(self.system), rows_for(self.training, self.model.system, self.system)
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
        return components_of(self.model.prior, dynamics, latents, self.model.mean == "analytical")

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
        prior, robot = self.model.prior, self.model.system.robot
        with torch.no_grad():
            given = prior.features(self.likelihood.dynamics(self.parameters))[index]
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
        return self.model.prior.latent_names(self.model.system.robot)

    @override
    def with_system(self, system: MechanicalSystem) -> "StructuredPosterior":
        """The same forces in another system (robot, contacts, known forces, stabilisation) with the same joints.

        Raises InvalidInput for other joints, and, without an analytical mean, for another robot: the processes hold
        the weight and inertia of the one that they were trained on; UnknownFrame where a force acts on a frame that the
        robot lacks.
        """
        require_type("system", system, MechanicalSystem)
        trained = self.model.system
        if system.robot.joint_names != trained.robot.joint_names:
            raise InvalidInput(
                f"the model was trained on joints {', '.join(trained.robot.joint_names)}; the other robot has "
                f"{', '.join(system.robot.joint_names)}. Forces can move to robots with the same joints only."
            )
        if self.carries_known_forces and not system.robot.tree.equals(trained.robot.tree):
            raise InvalidInput(
                "the model has no analytical mean, so its processes hold gravity and inertia of the robot that it was "
                "trained on and cannot move to another; fit with `mean='analytical'`."
            )
        # asks for the frames, at a state where a surface is likely to have a normal
        q, v, u = (x[:1].to(system.robot.device) for x in (self.training.q, self.training.v, self.training.u))
        u = u.new_zeros(1, system.sizes[2]) if len(u[0]) != system.sizes[2] else u
        self.model.prior.mixing(system.dynamics(q, v, u, inertials_of(self.parameters) or None))
        # the training rows are always conditioned in their own system: nothing is factorised again, no number changes
        # widths of intervals of motions were found in the system before
        kept = {name: value for name, value in self.settings.items() if name != "motion_intervals"}
        return replace(self, target=system, settings=kept)

    @override
    def to(self, device: torch.device | str) -> "StructuredPosterior":
        return replace(super().to(device), identification=self.identification)

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
        example = ", for example Dataset(q=q, v=v, u=u, a=a, time=t, system=posterior.system)"
        require_rows("rows", rows, self.system.robot.joint_names, "the model", example)
        own, rows = replace(self, target=None), rows_of_own_system(self, rows)
        if horizon is None:
            return replace(learn_more_rows(own, rows, budget, keep), target=self.target)
        return replace(learn_and_forget(own, rows, budget, horizon), target=self.target)

    @override
    def refined_on_motions(
        self,
        dataset: Dataset,
        seconds: float = 1.0,
        *,
        inertias: bool = True,
        report: Callable[[int, float], None] | None = None,
    ) -> "StructuredPosterior":
        return refine_on_motions(self, dataset, seconds, inertias, report)

    @override
    def calibrated_on_motions(
        self,
        dataset: Dataset,
        horizons: Sequence[float] = HORIZONS,
        *,
        integrator: str = "rk4",
        report: Callable[[int, int], None] | None = None,
    ) -> "StructuredPosterior":
        intervals = calibrate_motions(self, dataset, horizons, integrator, report)
        return self.with_settings(motion_intervals=intervals.to_dict())

    @property
    @override
    def motion_intervals(self) -> MotionIntervals | None:
        stored = self.settings.get("motion_intervals")
        found = None if stored is None else MotionIntervals.from_dict(stored)
        # widths of motions that an observer's columns were part of are not those of motions without
        return None if found is None or found.inputs not in ((), self.system.inputs) else found

    @override
    def accelerations(self, baumgarte: Baumgarte | None) -> AccelerationModel:
        if baumgarte is not None and not self.system.contacts:
            raise InvalidInput("baumgarte was given, but the model's system has no contacts; give baumgarte=None.")
        system = replace(self.system, baumgarte=baumgarte)
        prior, standardize = self.model.prior, self.likelihood.standardization
        inertials = inertials_of(self.parameters) or None

        def through(functions: Callable[[list[Tensor]], Tensor]) -> AccelerationFunction:
            def acceleration(q: Tensor, v: Tensor, u: Tensor) -> Tensor:
                dynamics = system.dynamics(q, v, u, inertials)
                affine, _ = self.acceleration_map(dynamics)
                mixing = prior.mixing(dynamics)
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
            return self.code(system).loops(integrator, self.latent, samples, seed)

        return AccelerationModel(system, baumgarte, mean, sampled, compiled)

    def code(
        self, system: MechanicalSystem | None = None, compressed: CompressedCovariance | None = None
    ) -> PredictorCode:
        """The mean as a graph, from which programs are written, in another system if one is given.

        Raises InvalidInput for operations that no graph holds, models on another device, and noisy torques.
        """
        system = self.system if system is None else system
        self._require_commanded_torques()
        rows = rows_for(self.training, self.model.system, system)
        example = [x[:1] for x in (rows.q, rows.v, rows.u)]
        return PredictorCode.of(
            self._physics(system), example, system.robot.space, self.latent, compressed, self.widening
        )

    def _require_commanded_torques(self) -> None:
        noise = self.model.noise
        if noise is not None and noise.measured_torque:
            raise InvalidInput(
                "a predictor is for commanded torques, and in this model u comes from a noisy sensor; call "
                "predict, or fit with Noise(..., measured_torque=False)."
            )

    def _physics(self, system: MechanicalSystem) -> PredictorPhysics:
        inertials = {name: value.detach() for name, value in inertials_of(self.parameters).items()} or None
        model, standardization = self.model, self.likelihood.standardization
        return PredictorPhysics(system, model.prior, model.mean == "analytical", inertials, standardization)

    def at_iteration(self, iteration: int) -> "StructuredPosterior":
        """The posterior as it was after that iteration of the search (0: the start), its system included.

        Raises InvalidInput unless the fit kept its iterates: with `learn`, or `OptimizerOptions(keep_iterates=True)`.
        """
        kept = self.result.iterates
        if not 0 <= iteration < len(kept):
            raise InvalidInput(
                f"iteration {iteration} was not kept; there are {len(kept)}, from 0. Call identify, or give "
                "options=OptimizerOptions(keep_iterates=True)"
            )
        point = {**self.parameters, **kept[iteration]}
        z = point.pop(PHYSICAL, None)
        model = self.model
        if z is not None and self.identification is not None:
            model = replace(model, system=self.identification.physical.system_at(z))
        moved: Any = model.condition(self.training, point, self.result, self.settings, self.engine)
        return replace(moved, target=self.target)

    @override
    def leave_out(self, blocks: Sequence[Sequence[int]] | None = None) -> LeaveOut:
        with torch.no_grad(), blas_threads(self.training.q.numel()):
            *_, noise = self.likelihood.terms(self.parameters)
            return leave_blocks_out(exact(self.latent, "leaving rows out").system, noise, blocks)

    @cached_property
    def negative_log_likelihood(self) -> float:
        """-log p(a | q, v, u) of the training data at the fitted parameters, in nats, without any hyperprior.

        With inducing points its upper bound.
        """
        with torch.no_grad():
            if isinstance(self.latent, InducingPosterior):
                return float(self.likelihood.bound(self.kernels, self.parameters, self.latent.features))
            return float(self.likelihood(self.kernels, self.parameters))

    @property
    @override
    def noise_std(self) -> Float[Tensor, "nv"]:
        return self.parameters[ACCELERATION].exp()


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
