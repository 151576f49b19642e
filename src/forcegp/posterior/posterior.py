"""`Posterior`: what a fit knows of a model, as a value that predicts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, overload

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.data import Dataset
from forcegp.data.dataset import require_rows
from forcegp.errors import InvalidInput, NumericalError, require_type, usable_arguments
from forcegp.evidence import Accelerations
from forcegp.evidence.likelihood import MarginalLikelihood
from forcegp.evidence.training_data import TrainingData, second_moments, shrunk
from forcegp.forces import Force, IndependentAccelerations, JointAccelerations, JointForces
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
from forcegp.inference.prepared_kernels import CompressedCovariance
from forcegp.inference.threads import blas_threads
from forcegp.integration import Feedback
from forcegp.integration.integrators import check_time_step
from forcegp.mechanics import AffineMap, Baumgarte, ConstrainedDynamics, Contact
from forcegp.model import Model
from forcegp.noise import ACCELERATION, FORCE, Noise
from forcegp.posterior.components import Components, Curve, components_of, curve_of, quantity_of
from forcegp.posterior.estimates import Estimates
from forcegp.posterior.motion_intervals import MotionIntervals
from forcegp.posterior.observed_wrench import rows_of_own_system
from forcegp.posterior.prediction import (
    ROWS_PER_BLOCK,
    Array,
    Gaussian,
    Inputs,
    Positions,
    Prediction,
    Rows,
    join_predictions,
    state_rows,
    state_tensor,
)
from forcegp.posterior.predictor import Predictor
from forcegp.posterior.predictor_code import PredictorCode
from forcegp.posterior.predictor_preparation import physics_of, prepared_predictor, rows_for
from forcegp.posterior.rollout import AccelerationModel, Rollout, accelerations_of, remembering, roll_out
from forcegp.posterior.update import Keep, learn_and_forget, learn_more_rows
from forcegp.robots import Robot
from forcegp.summary import Summary, rounded


@dataclass(frozen=True, eq=False, repr=False)
class Posterior(Summary):
    """a = M^-1 Q_b + H (Q_K + B f) + noise, f ~ GP (Rath et al. 2021, eqs. 6-7), conditioned on a log by `forcegp.fit`.

    `trained` is the model with the numbers that were found; `hyperparameters` are those of kernels and noise by name;
    `estimates` the numbers of laws and bodies (`parameters`); `settings` is the resolved configuration of the fit
    (plain JSON values), with at least `points` (training rows), `seed` and `data` (metadata and episodes of the
    training data); `result` is the history of the search and why it ended.
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
    """The model that predictions are for, where it is not the one that was trained (`with_model`)."""

    @property
    def model(self) -> Model:
        """What predictions are for: robot, contacts and forces."""
        return self.trained if self.target is None else self.target

    @property
    def parameters(self) -> Estimates:
        """Numbers of laws and bodies that the fit estimated, with intervals, and whether the log decides them."""
        return self.estimates

    @classmethod
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
    ) -> "Posterior":
        """The posterior at given hyper-parameters, without a search: what a stored one is loaded with.

        `engine` computes it, where there is a choice; `solution` is what that engine had found (`Posterior.solution`),
        which saves it most of its work.
        """
        likelihood = MarginalLikelihood(model, replace(training, correlated_rows=settings.get("correlated_rows", 1.0)))
        engine = engine or Exact()
        # now: a failure belongs to the fit, not to the first prediction
        latent = likelihood.condition(likelihood.kernels, hyperparameters, engine, start=solution)
        found = dict(hyperparameters), result, dict(settings), latent, engine, estimates or Estimates()
        return cls(model, likelihood, *found)

    @staticmethod
    def parameter_shapes(model: Model, training: TrainingData) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the hyper-parameters that a posterior on these rows needs."""
        return MarginalLikelihood(model, training).parameter_shapes

    @property
    def kernels(self) -> LatentKernels:
        """Of the latent functions, at their start values."""
        return self.likelihood.kernels

    @property
    def training(self) -> TrainingData:
        """The rows that the model was trained on."""
        return self.likelihood.training

    @property
    def noise_std(self) -> Float[Tensor, "nv"]:
        """Standard deviation of the acceleration noise per joint, given, learned or estimated."""
        return self.hyperparameters[ACCELERATION].exp()

    @property
    def solution(self) -> Tensor | None:
        """What conditioning on these rows again can begin from, stored with the model; None where it is cheap."""
        return self.engine.solution(self.latent)

    @cached_property
    def negative_log_likelihood(self) -> float:
        """-log p(a | q, v, u) of the training data at the fitted parameters, in nats, without any hyperprior.

        With inducing points its upper bound.
        """
        with torch.no_grad():
            if isinstance(self.latent, InducingPosterior):
                return float(self.likelihood.bound(self.kernels, self.hyperparameters, self.latent.features))
            return float(self.likelihood(self.kernels, self.hyperparameters))

    @override
    def facts(self) -> dict[str, object]:
        """Model, robot, training rows, and how the search ended."""
        rows, result = self.training, self.result
        return {
            "model": self.description,
            "robot": f"{self.model.robot.name!r}, {self.model.robot.nv} joints, {len(self.model.contacts)} contacts",
            "learned from": f"{len(rows)} {'rows' if rows.weights is None else 'windows'}",
            "noise std": rounded(self.noise_std.tolist()),
            "search": f"{'converged' if result.converged else 'not converged'}, {result.status}",
        }

    @property
    def description(self) -> str:
        """What kind of model it is, in a few words, for titles and tables."""
        forces = self.trained.unknown
        mean = "zero mean" if self.carries_known_forces else "analytical mean"
        if not forces.terms:
            return "identified model" if self.estimates else "analytical model"
        if self.is_black_box:
            return "independent GP"
        if isinstance(forces.terms[0], JointAccelerations):
            return f"unconstrained accelerations, {mean}"
        names = list(forces.term_names)
        shown = "" if names == [JointForces().title] else f"{' + '.join(names)}, "
        return f"{shown}{mean}"

    @property
    def is_black_box(self) -> bool:
        """Whether it learned accelerations, whatever the forces are, and predicts nothing else."""
        return any(isinstance(force, IndependentAccelerations) for force in self.trained.unknown_forces)

    @property
    def carries_known_forces(self) -> bool:
        """Whether the predicted `unknown_force` holds the known forces, too."""
        return self.trained.carries_known_forces

    @property
    def motion_intervals(self) -> MotionIntervals | None:
        """Widths of the intervals of motions, where they were calibrated (`forcegp.calibrated`); a rollout has them."""
        stored = self.settings.get("motion_intervals")
        found = None if stored is None else MotionIntervals.from_dict(stored)
        # widths of motions that an observer's columns were part of are not those of motions without
        return None if found is None or found.inputs not in ((), self.model.inputs) else found

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints in the order of every last dimension."""
        return self.model.robot.joint_names

    @property
    def objective(self) -> str:
        """What `result.history` holds, with its unit in brackets."""
        return "negative log likelihood with hyperpriors [nats]"

    @property
    def latent_names(self) -> tuple[str, ...]:
        """The processes that the prior is made of."""
        return self.trained.unknown.latent_names(self.trained.robot)

    @property
    def widening(self) -> float:
        """How many times as wide intervals are as those of `latent`, whose hyper-parameters count as known.

        `fit/widening.py` says why and how much; `posterior.with_settings(widening=1.0)` does without.
        """
        return float(self.settings.get("widening", 1.0))

    def dynamics(
        self, q: Float[Tensor, "*batch nq"], v: Float[Tensor, "*batch nv"], u: Float[Tensor, "*batch nu"]
    ) -> ConstrainedDynamics:
        """The constrained dynamics of these states, with the model's inertial parameters."""
        return self.model.dynamics(q, v, u)

    @overload
    def predict(self, q: Array, v: Array, u: Array, *, covariance: bool = ..., of: None = ...) -> Prediction: ...

    @overload
    def predict(
        self, q: Array, v: Array, u: Array, *, covariance: bool = ..., of: Sequence[Accelerations | Contact | Force]
    ) -> tuple[Gaussian, ...]: ...

    def predict(
        self,
        q: Array,
        v: Array,
        u: Array,
        *,
        covariance: bool = True,
        of: Sequence[Accelerations | Contact | Force] | None = None,
    ) -> Prediction | tuple[Gaussian, ...]:
        """Distribution of the acceleration and, where the model predicts them, of the forces behind it.

        It is a `Prediction`, or with `of` a tuple with one `Gaussian` for each quantity in it: `Accelerations()`, a
        contact of the model (the force on the robot there, (..., 3) in N), or an unknown force of it (its joint force).

        States (..., nv) are in rad, rad/s and Nm (m, m/s and N for prismatic joints). Arrays, lists and tensors are
        taken; results are float64 tensors. With `covariance=False` only means are computed, much faster. Differentiable
        in q, v and u where these are tensors that require gradients.
        Raises InvalidInput for wrong shapes or values that are not finite, and inside `torch.func.vmap`, whose batch
        the leading dimensions are; NumericalError where the result is not finite.
        """
        require_type("covariance", covariance, bool)
        states, batch = self.checked_states(q, v, u)
        parts = zip(*(x.split(ROWS_PER_BLOCK) for x in states), strict=True)
        blocks = [self.predict_rows(q, v, u, covariance) for q, v, u in parts]
        predicted = join_predictions(blocks, batch)
        # lost where a state is so large, or a system so singular, that nothing is left of the numbers
        variance = predicted.mean if predicted.covariance is None else predicted.variance
        finite = torch.isfinite(predicted.mean.detach() + variance.detach()).reshape(-1, variance.shape[-1]).all(-1)
        if not bool(finite.all()):
            raise NumericalError(
                f"the prediction of row {int((~finite).nonzero()[0])} is not finite: q, v or u is too large for "
                "float64 there, the mass matrix is singular, or a surface has no normal; check q, v and u of that "
                "row, and the model by Model.check_states."
            )
        return predicted if of is None else tuple(quantity_of(self, each, predicted, (q, v, u)) for each in of)

    def predict_rows(self, q: Positions, v: Rows, u: Inputs, covariance: bool) -> Prediction:
        """`predict` for one block of checked states."""
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
        if self.is_black_box:  # its functions hold what contacts do, so forces are not those of anything
            return Prediction(predicted.mean, spread, None, None, None, _noise_covariance(noise, dynamics))
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
        return curve_of(self, latent, features, points)

    def predictor(
        self, *, covariance: str = "auto", tolerance: float = 0.01, largest_rank: int = 1536, compile: bool = True
    ) -> Predictor:
        """The accelerations of `predict` at control rates: one state at a time in fractions of a millisecond.

        Parameters
        ----------
        covariance: "compressed" uses so few combinations of the data that standard deviations are up to `tolerance`
            (relative) larger than the exact ones at states around the training data, and never smaller; "exact" is the
            covariance of `predict`; "none" leaves it out and prepares faster. "auto" is "compressed" after exact
            inference, and "exact" after another engine, which lacks what compression needs.
        tolerance, largest_rank: the rank is the smallest that keeps the tolerance, and at most `largest_rank`; a
            NumericalWarning is given where that does not suffice.
        compile: rigid-body terms and kernels as machine code on the CPU; False computes by torch, on any device. Where
            no C compiler works, torch does, too, and a NumericalWarning says so.

        Raises
        ------
        InvalidInput: an argument is out of range, a model is not a structured Gaussian process, or cannot be compiled.
        """
        how: Any = {"covariance": covariance, "tolerance": tolerance, "largest_rank": largest_rank, "compile": compile}
        physics, training = physics_of(self, self.model), rows_for(self.training, self.trained, self.model)
        return replace(prepared_predictor(self.latent, self.widening, training, physics, **how), posterior=self)

    def checked_states(self, q: Array, v: Array, u: Array) -> tuple[list[Tensor], torch.Size]:
        """States as rows of float64 tensors on the model's device, and their batch dimensions.

        Raises InvalidInput for wrong shapes or values that are not finite.
        """
        return state_rows(self.model, q, v, u)

    def code(self, model: Model | None = None, compressed: CompressedCovariance | None = None) -> PredictorCode:
        """The mean as a graph, from which programs are written, in another system if one is given.

        Raises InvalidInput for operations that no graph holds, models on another device, and noisy torques.
        """
        model = self.model if model is None else model
        physics = physics_of(self, model)
        rows = rows_for(self.training, self.trained, model)
        example = [x[:1] for x in (rows.q, rows.v, rows.u)]
        return PredictorCode.of(physics, example, model.robot.space, self.latent, compressed, self.widening)

    def rollout(
        self,
        q0: Array,
        v0: Array,
        u: Array,
        dt: float,
        *,
        integrator: str = "symplectic-euler",
        baumgarte: Baumgarte | None = None,
        feedback: Feedback | None = None,
        samples: int = 0,
        seed: int = 0,
        grad: bool = False,
        progress: Callable[[int, int], None] | None = None,
    ) -> Rollout:
        """Where the robot goes from (q0, v0) under the forces u: the integrated mean acceleration.

        Parameters
        ----------
        q0, v0: initial states (..., nv) in rad and rad/s (m and m/s), any batch.
        u: actuator forces (..., T, nv) in Nm or N; row k acts from k to k + 1. Batches broadcast. An `ObservedWrench`
            follows from the first row.
        dt: time step in s.
        integrator: "symplectic-euler" (first order, as in PyBullet and the paper), "rk4" (fourth order),
            "implicit-midpoint" (second order, for stiff friction) or "projected" (second order; contacts hold exactly
            after every step, also in the first state, which is moved onto them).
        baumgarte: stabilisation in this rollout, instead of that of the model; None for none.
        feedback: a controller that adds to u: feedback(k, q, v) -> (..., nv) in Nm or N, asked once at the beginning of
            step k and constant until k + 1, with the batch dimensions of the motions (those of q0, for sampled motions
            after one for the samples). Without one the motion is open loop, where small errors of a model grow as the
            robot lets them.
        samples: also integrate this many functions drawn from the posterior, by pathwise conditioning; `seed` draws
            them.
        grad: keep the graph, so that the result can be differentiated once in q0, v0, u and what `feedback` adds.
            Memory grows with the number of steps.
        progress: called as progress(step, steps).

        A motion that diverges is NaN from then on, `Rollout.diverged_at` holds the row, and a NumericalWarning is
        given. Raises InvalidInput for arguments that do not fit, among them tensors that require a gradient without
        `grad`, NumericalError where the initial state cannot be projected.
        """
        model = self.accelerations(baumgarte)
        if self.model.held_inputs:
            check_time_step(dt)
            u = self.model.foreseen(state_tensor("u", u, self.model.sizes[2], self.model.robot.device), dt)
        if self.model.memory.names:
            given = state_tensor("u", u, self.model.sizes[2], self.model.robot.device)
            u, feedback = remembering(self.model, given, dt, feedback)
        how: dict[str, Any] = {"feedback": feedback, "samples": samples, "seed": seed, "progress": progress}
        moved = roll_out(model, q0, v0, u, dt, integrator=integrator, grad=grad, **how)
        return replace(moved, intervals=self.motion_intervals)

    def accelerations(self, baumgarte: Baumgarte | None) -> AccelerationModel:
        """What `rollout` integrates, under this stabilisation. Raises InvalidInput for one without contacts."""
        return accelerations_of(self, baumgarte)

    def leave_out(self, blocks: Sequence[Sequence[int]] | None = None) -> LeaveOut:
        """How well training rows are predicted from those outside their block: in closed form, without another fit.

        `blocks` holds numbers of training rows; None leaves one row out at a time. Rows that follow each other in time
        hold nearly the same information, so leave them out together: `forcegp.data.time_blocks`. The parameters stay
        those that were fitted to all rows, so the scores flatter a model with many of them a little.
        Raises InvalidInput for blocks that overlap, and for models that would have to be trained again.
        """
        with torch.no_grad(), blas_threads(self.training.q.numel()):
            *_, noise = self.likelihood.terms(self.hyperparameters)
            return leave_blocks_out(exact(self.latent, "leaving rows out").system, noise, blocks)

    def update(
        self,
        rows: Dataset,
        budget: int | None = None,
        *,
        keep: Keep = rows_to_keep,
        horizon: float | Mapping[str, float] | None = None,
    ) -> "Posterior":
        """A new posterior that has learned from more rows, too; this one stays as it is.

        Parameters, noise level and standardization stay those of the fit, so the result is exactly that of
        conditioning on all rows at once, in time O(N^2) for N rows instead of O(N^3).

        Parameters
        ----------
        rows: with the same joints, of the robot that the model was trained on.
        budget: keep this many rows at most: those that the posterior would change most without
            (docs/how-to/incremental.md).
            The result is then exactly that of conditioning on these. None keeps all.

        Raises InvalidInput for rows that do not fit and for models that would have to be trained again, ContactError
        for rows at which the contacts cannot hold.
        """
        example = ", for example Dataset(q=q, v=v, u=u, a=a, time=t, model=posterior.model)"
        require_rows("rows", rows, self.model.robot.joint_names, "the model", example)
        own, rows = replace(self, target=None), rows_of_own_system(self, rows)
        if horizon is None:
            return replace(learn_more_rows(own, rows, budget, keep), target=self.target)
        return replace(learn_and_forget(own, rows, budget, horizon), target=self.target)

    def with_model(self, model: Model) -> "Posterior":
        """The same unknown forces in another model (robot, contacts, laws, stabilisation) with the same joints.

        Those of contacts that it lacks are zero there, and its `forces` do not list them.

        Raises InvalidInput for other joints, and, without `RigidBodies`, for another robot: the processes hold
        the weight and inertia of the one that they were trained on; UnknownFrame where a force acts on a frame that the
        robot lacks.
        """
        require_type("model", model, Model)
        trained = self.trained
        if self.is_black_box:
            raise InvalidInput(
                f"a {self.description} learned the accelerations of one robot, so it cannot move to another model; fit "
                "it to data from there, or learn forces."
            )
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

    def with_contacts(self, contacts: Sequence[Contact | Sequence[Contact]]) -> "Posterior":
        """The same knowledge under other contacts, without another fit: another surface, or none at all, `[]`.

        What was learned of joint forces stays as it is; forces of a contact follow the contact with their number, and
        are zero without it. Raises InvalidInput as `with_model`.
        """
        return self.with_model(self.model.known.with_contacts(contacts))

    def with_robot(self, robot: Robot) -> "Posterior":
        """The same knowledge on another robot with the same joints, for example with another known tool.

        Raises InvalidInput as `with_model`.
        """
        return self.with_model(self.model.with_robot(robot))

    def to(self, device: torch.device | str) -> "Posterior":
        """The same knowledge on another device, for instance "cuda": conditioned there on the same rows.

        Raises InvalidInput for a device that is not there.
        """
        model = self.trained.to(device)
        at: torch.device = model.robot.device
        result = replace(
            self.result,
            parameters=_all_on(self.result.parameters, at),
            iterates=tuple(_all_on(point, at) for point in self.result.iterates),
        )
        there = Posterior.conditioned(
            model,
            self.training.to(at),
            _all_on(self.hyperparameters, at),
            result,
            self.settings,
            engine=self.engine,
            solution=None if self.solution is None else self.solution.to(at),
            estimates=self.estimates,
        )
        carried = there if self.target is None else there.with_model(self.target.to(device))
        return carried.with_settings(**self.settings)

    def with_settings(self, **settings: Any) -> "Posterior":
        """The same posterior with more entries in `settings`."""
        return replace(self, settings={**self.settings, **settings})


def _all_on(tensors: Mapping[str, Tensor], device: torch.device) -> dict[str, Tensor]:
    return {name: value.to(device) for name, value in tensors.items()}


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
