"""`Posterior`: what a fit knows of a model, as a value that predicts."""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset, with_memory
from forcegp.data.dataset import FORCE as OF_SENSOR
from forcegp.data.dataset import require_rows
from forcegp.data.views import decided
from forcegp.errors import DataWarning, InvalidInput, NumericalError, require_known, require_type, usable_arguments
from forcegp.evidence.likelihood import TrainingData, check_distance
from forcegp.forces import Force
from forcegp.inference import exact
from forcegp.inference.memory import blas_threads, require_memory
from forcegp.inference.posterior import with_rows
from forcegp.inference.prepared_kernels import CompressedCovariance
from forcegp.integration.integrators import Feedback, steps_by
from forcegp.mechanics import AffineMap, Baumgarte, ConstrainedDynamics, Contact
from forcegp.model import Model
from forcegp.noise import ACCELERATION, FORCE, PUSHES, Noise
from forcegp.posterior.drift import followed
from forcegp.posterior.fitted import Fitted
from forcegp.posterior.observed_wrench import rows_of_own_system
from forcegp.posterior.prediction import (
    ROWS_PER_BLOCK,
    Array,
    Curve,
    ForceComponent,
    Gaussian,
    Inputs,
    Positions,
    Prediction,
    Rows,
    curve_features,
    hidden_forces,
    join_predictions,
    joint_forces_given,
    state_rows,
    state_tensor,
    without_past,
)
from forcegp.posterior.predictor import Predictor
from forcegp.posterior.preparation import prepared_predictor, rows_for
from forcegp.posterior.programs import Physics, Programs
from forcegp.posterior.rollout import Rollout, accelerations, checked_start, flat_feedback, loops_for, moved
from forcegp.robots.arguments import broadcast_batch, real_tensor, whole_number


@dataclass(frozen=True, eq=False, repr=False)
class Posterior(Fitted):
    """a = M^-1 Q_b + H (Q_K + B f) + noise, f ~ GP (Rath et al. 2021, eqs. 6-7), conditioned on a log by `forcegp.fit`.

    It predicts, rolls out, becomes programs, learns more rows, moves to other models. Its fields are `Fitted`'s.
    """

    def dynamics(
        self, q: Float[Tensor, "*batch nq"], v: Float[Tensor, "*batch nv"], u: Float[Tensor, "*batch nu"]
    ) -> ConstrainedDynamics:
        """The constrained dynamics of these states, with the model's inertial parameters."""
        return self.model.dynamics(q, v, u)

    def predict(self, q: Array, v: Array, u: Array, *, a: Array | None = None, covariance: bool = True) -> Prediction:
        """Distribution of the acceleration and, where the model predicts them, of the forces behind it.

        With `a`, accelerations that were measured in these states (..., nv), all is given these: what an estimator of
        contact forces without a force sensor needs (`Prediction.force_at`). States (..., nv) are in rad, rad/s and Nm
        (m, m/s and N), arrays, lists or tensors; `covariance=False` is much faster. Differentiable in q, v and u. Where
        laws remember, u has columns for that (`forcegp.data.with_memory` makes them of a log); without these the past
        counts as unknown, in the mean and in the covariance, and a DataWarning says so. InvalidInput for wrong shapes,
        values that are not finite, and inside `vmap`; NumericalError where the result is not finite.
        """
        require_type("covariance", covariance, bool)
        memory, without = self.model.memory.names, (self.model.sizes[2] - len(self.model.memory.names),)
        past = not memory or real_tensor("u", u, self.model.robot.device).shape[-1:] != without
        predict = self.predict_rows if past else partial(without_past, self)
        if not past:
            what = f"u has no columns {', '.join(memory)}, so that the past of friction counts as unknown"
            warnings.warn(f"{what}; forcegp.data.with_memory adds them to a log.", DataWarning, stacklevel=2)
        states, batch = state_rows(self.model, q, v, u, past)
        if a is not None:
            if self.is_black_box:
                raise InvalidInput(f"a {self.description} predicts no forces, which a could tell about; leave a out.")
            rows = state_tensor("a", a, self.model.robot.nv, self.model.robot.device)
            broadcast_batch({"q, v, u": batch, "a": rows.shape[:-1]})
            states = [*states, rows.expand(*batch, -1).reshape(batch.numel(), -1)]
        parts = zip(*(x.split(ROWS_PER_BLOCK) for x in states), strict=True)
        predicted = join_predictions([predict(q, v, u, covariance, *seen) for q, v, u, *seen in parts], batch)
        # lost where a state is so large, or a system so singular, that nothing is left of the numbers
        variance = predicted.mean if predicted.covariance is None else predicted.variance
        finite = torch.isfinite(predicted.mean.detach() + variance.detach()).reshape(-1, variance.shape[-1]).all(-1)
        if not bool(finite.all()):
            seen = f"the prediction of row {int((~finite).nonzero()[0])} is not finite"
            why = "q, v or u is too large for float64 there, the mass matrix is singular, or a surface has no normal"
            raise NumericalError(f"{seen}: {why}; check q, v and u of that row, and the model by Model.check_states.")
        return predicted

    def predict_rows(self, q: Positions, v: Rows, u: Inputs, covariance: bool, a: Rows | None = None) -> Prediction:
        """`predict` for one block of checked states."""
        dynamics, given = self.dynamics(q, v, u), self.hyperparameters
        B, motion = self.trained.unknown.direction(dynamics), dynamics.acceleration_map()
        latents = self.latents(dynamics, covariance or a is not None)
        seen = None if a is None else (a, given[ACCELERATION].exp())
        whole, learned = joint_forces_given(latents, B, self.unlearned(dynamics), motion, seen)
        moving = (learned if seen is None else whole).through(motion.matrix, motion.offset)
        if not covariance:
            whole, learned, moving = (Gaussian(each.mean, None) for each in (whole, learned, moving))

        def through(affine: AffineMap) -> Gaussian:
            return whole.through(affine.matrix, affine.offset)

        noise = Noise.covariance(given, dynamics.H)
        noise = torch.diag_embed(noise).expand_as(dynamics.H) if noise.dim() == 2 else noise
        if self.is_black_box:  # its functions hold what contacts do, so forces are not those of anything
            return Prediction(moving.mean, moving.covariance, None, None, None, noise)
        multiplier = through(dynamics.multiplier_map())
        forces = multiplier, through(dynamics.contact_force_map()), learned
        frames = tuple(contact.frame for contact in self.model.contacts)
        unseen = self._unseen(multiplier, dynamics) if covariance else None
        return Prediction(moving.mean, moving.covariance, *forces, noise, frames, dynamics.off(), unseen)

    def unlearned(self, dynamics: ConstrainedDynamics) -> Tensor | None:
        """The covariance of joint forces beside what was learned: noise, what pushed, and what contacts hid."""
        given, left = self.hyperparameters, self._hidden(dynamics)
        levels = [given[name].exp().square() for name in (FORCE, PUSHES) if name in given]
        found = torch.diag_embed(torch.stack(levels).sum(0)) if levels else None
        return found if left is None else left if found is None else left + found

    def _unseen(self, multiplier: Gaussian, dynamics: ConstrainedDynamics) -> Tensor:
        left, matrix = self._hidden(dynamics), dynamics.multiplier_map().matrix
        if left is None:
            return torch.zeros_like(multiplier.mean)
        own = (matrix @ left @ matrix.mT).diagonal(dim1=-2, dim2=-1)
        return own / multiplier.variance.clamp_min(torch.finfo(own.dtype).tiny)

    def _hidden(self, dynamics: ConstrainedDynamics) -> Tensor | None:
        hidden = self.settings.get("hidden_force")
        if hidden is None or not dynamics.A.shape[-2]:
            return None
        at_contacts = {f"{OF_SENSOR}{contact.frame}" for contact in dynamics.contacts}
        frames = [name for name in self.training.sensed if name in at_contacts]
        return hidden_forces(torch.tensor(hidden, dtype=torch.float64).to(dynamics.H), dynamics, frames)

    def latents(self, dynamics: ConstrainedDynamics, covariance: bool) -> Gaussian:
        """All processes at a batch of states: mean (..., C), and their joint covariance (..., C, C) where asked for."""
        batch = dynamics.state.q.shape[:-1]
        given = self.likelihood.standardization(self.trained.unknown.features(dynamics))
        features = [z.reshape(batch.numel(), z.shape[-1]) for z in given]
        if not (latents := len(features)):
            nothing = dynamics.state.q.new_zeros(*batch, 0, 0)
            return Gaussian(nothing.flatten(-2), nothing if covariance else None)
        mean, spread = self.latent.mean(features).reshape(*batch, latents), None
        if covariance:
            spread = self.widening**2 * self.latent.covariance(features).reshape(*batch, latents, latents)
        return Gaussian(mean, spread)

    def components(self, q: Array, v: Array, u: Array, *, covariance: bool = True) -> dict[str, ForceComponent]:
        """Every force by itself: each term of the prior, from this one fit; `predict` has their sum.

        `components(q, v, u)["joint-friction"].joint_force` is a `Gaussian` (..., nv) in Nm or N. Raises as `predict`.
        """
        require_type("covariance", covariance, bool)
        states, batch = state_rows(self.model, q, v, u)
        dynamics = self.dynamics(*(x.reshape(*batch, x.shape[-1]) for x in states))
        latents, robot, parts = self.latents(dynamics, covariance), dynamics.state.robot, {}
        B = self.trained.unknown.direction(dynamics)
        for name, term, which in self.trained.unknown.named(robot):
            own, mixing, point = latents.entries(which), B[..., which], term.point_force(dynamics)
            latent = own, own.through(mixing), own.through(dynamics.H @ mixing)
            at_point = None if point is None else own.through(point)
            parts[name] = ForceComponent(name, term.latent_names(robot), term.latent_units(robot), *latent, at_point)
        return parts

    @usable_arguments("curve")
    def curve(self, latent: str, features: Array | None = None, *, points: int = 200) -> Curve:
        """One process of the prior, one of `latent_names`, over its features: a friction curve, for example.

        `features` are (n, d) in the units of `prior.feature_names`, (n,) for one feature, or None for `points` values
        over the range of the training data. InvalidInput for another name, wrong shapes, and None for several features.
        """
        names, prior, robot = self.latent_names, self.trained.unknown, self.trained.robot
        require_known("latent", latent, "this model", names)
        index = names.index(latent)
        with torch.no_grad():
            given = prior.features(self.likelihood.dynamics)[index]
            visited = torch.stack([given.amin(0), given.amax(0)]) if given.shape[-1] else given[:2]
            z, known = curve_features(latent, features, visited, points), self.likelihood.standardization
            mean, variance = self.latent.one(index, (z - known.shift[index]) / known.scale[index])
        labels = prior.feature_names(robot)
        inputs = tuple(f"feature {k}" for k in range(z.shape[-1])) if labels is None else labels[index]
        std = self.widening * variance.clamp_min(0.0).sqrt()
        return Curve(latent, prior.latent_units(robot)[index], inputs, z, mean, std, visited)

    def predictor(self, *, covariance: str = "auto", compile: bool = True) -> Predictor:
        """The accelerations of `predict` at control rates: one state at a time in fractions of a millisecond.

        `covariance` "compressed" uses so few combinations of the data, 1536 at most (a NumericalWarning says where that
        does not suffice), that standard deviations are up to 1 % larger than the exact ones around the training data,
        and never smaller; "exact", "none"; "auto" is "compressed" after exact inference, else "exact". `compile=False`
        computes by torch, on any device, as does a computer without a C compiler, with a NumericalWarning. Raises
        InvalidInput for arguments out of range and models that cannot be compiled.
        """
        return prepared_predictor(self, covariance, compile)

    def programs(self, model: Model | None = None, compressed: CompressedCovariance | None = None) -> Programs:
        """What is compiled and exported, in another model if one is given.

        Raises InvalidInput for other devices and noisy torques and, when made of them, what no graph holds.
        """
        model = self.model if model is None else model
        rows = rows_for(self.training, self.trained, model)
        example = [x[:1] for x in (rows.q, rows.v, rows.u)]
        return Programs(Physics.of(self, model), example, self.latent, self.widening, compressed)

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
    ) -> Rollout:
        """Where the robot goes from (q0, v0) under the forces u: the integrated mean acceleration.

        `q0`, `v0` (..., nv) in rad and rad/s (m and m/s), `u` (..., T, nv) in Nm or N, row k from k to k + 1; batches
        broadcast; `dt` in s. An `ObservedWrench` follows from the first row. `integrator` is "symplectic-euler" (first
        order, as in PyBullet and the paper), "rk4" (fourth order) or "implicit-midpoint" (second order, for stiff
        friction); `baumgarte` stabilises instead of the model's, None: not at all. feedback(k, q, v) -> (..., nv) adds
        to u, asked at the beginning of step k, with the batch dimensions of the motions. `samples` functions drawn from
        the posterior with `seed` are integrated, too.

        A motion that diverges is NaN from then on, `diverged_at` holds the row, and a NumericalWarning is given. Raises
        InvalidInput for arguments that do not fit, and tensors that require a gradient, which no motion keeps.
        """
        if baumgarte is not None and not self.model.contacts:
            raise InvalidInput("baumgarte was given, but the model has no contacts; give baumgarte=None.")
        model = replace(self.model, baumgarte=baumgarte)
        method = steps_by(integrator, model, dt)
        if self.model.held_inputs:
            u = self.model.foreseen(state_tensor("u", u, self.model.sizes[2], self.model.robot.device))
        samples, seed = whole_number("samples", samples, 0), whole_number("seed", seed, 0)
        q, v, forces, batch = checked_start(model.sizes, model.robot.device, q0, v0, u)
        time = dt * torch.arange(len(forces) + 1, dtype=q.dtype, device=q.device)

        def run(copies: int, what: str) -> Rollout:
            shape, count = ((copies,) if copies else ()) + batch, max(1, copies)
            given = q.repeat(count, 1), v.repeat(count, 1), forces.repeat(1, count, 1), dt
            loops, added = None, None if feedback is None else flat_feedback(feedback, shape, forces.shape[-1])
            if feedback is None:
                loops = loops_for(self, model, integrator, forces.shape, copies, seed)
            work = accelerations(self, model, copies, seed)
            found = moved(shape, loops, method, work, model, *given, feedback=added, what=what)
            return Rollout(time, *found[:4], integrator, model)

        with torch.no_grad(), blas_threads(0):
            mean = run(0, "rollouts")
            drawn = run(samples, "sampled rollouts") if samples else None
        return replace(mean, samples=drawn, intervals=self.motion_intervals)

    def update(self, rows: Dataset) -> "Posterior":
        """A new posterior that has learned from more rows, too; this one stays as it is.

        Parameters, noise level and standardization stay, so it is that of conditioning on all rows at once, in O(N^2).
        Without unknown forces the level of dry friction follows rows in order of time, as far as `settings["drift"]`
        lets it: give the last seconds of a record, whose coming motions are to be predicted. Raises InvalidInput for
        rows that do not fit and models to be trained again, ContactError for rows at which the contacts cannot hold.
        """
        example = ", for example Dataset(q=q, v=v, u=u, a=a, time=t, model=posterior.model)"
        require_rows("rows", rows, self.model.robot.joint_names, "the model", example)
        own, rows = replace(self, target=None), rows_of_own_system(self, with_memory(rows, self.model))
        return followed(replace(own.with_rows(rows), target=self.target), rows)

    def with_rows(self, rows: Dataset) -> "Posterior":
        """Conditioned on rows of its own system, too: exactly, at the parameters that it has, in bounded memory."""
        rows, latent, training = decided(rows), exact(self.latent, "learning from more rows"), self.training
        count, rank, latents = latent.system.deflation.C.shape
        size, new = rank * (count + len(rows)), rank * len(rows)
        # the factor, blocks of new rows, their copies
        needed = 8 * (size**2 + 2 * new * size + latents * len(rows) ** 2)
        require_memory(needed, f"a posterior of {count} + {len(rows)} rows", "give fewer rows", training.q.device)
        # with the standardization at hand instead of one that is computed again
        reference = training if training.reference is None else training.reference
        added = TrainingData.of(rows, training.q.device, training.sensed)
        added, known = replace(added, reference=reference, correlated_rows=training.correlated_rows), self.likelihood
        known.model.check_states(added.q, added.v, added.u)
        check_distance(known.model, added)
        more = replace(known, training=added, fixed_standardization=known.standardization)
        with torch.no_grad(), blas_threads(training.q.numel()):
            terms = more.terms(self.hyperparameters)
            latent = with_rows(latent, terms._replace(noise=terms.noise.expand(len(terms.W), *terms.noise.shape[1:])))
        both = training, more.training
        sensed = {name: torch.cat([x.sensed[name] for x in both]) for name in training.sensed}
        pairs = {name: [getattr(x, name) for x in both] for name in (*"qvua", "strokes")}
        joined = {name: None if any(x is None for x in pair) else torch.cat(pair) for name, pair in pairs.items()}
        learned = replace(training, **joined, sensed=sensed, reference=more.training.reference)
        changes = {"points": len(latent.system.alpha), "rows_added": self.settings.get("rows_added", 0) + len(rows)}
        return replace(self, likelihood=replace(more, training=learned), latent=latent).with_settings(**changes)

    def with_model(self, model: Model) -> "Posterior":
        """The same unknown forces in another model (robot, contacts, laws, stabilisation) with the same joints.

        Forces of contacts that it lacks are zero there. Raises InvalidInput for other joints and, without
        `RigidBodies`, another robot, whose weight and inertia the processes lack; UnknownName for other frames.
        """
        require_type("model", model, Model)
        trained = self.trained
        if self.is_black_box:
            seen = f"a {self.description} learned the accelerations of one robot, so it cannot move to another model"
            raise InvalidInput(f"{seen}; fit it to data from there, or learn forces.")
        if model.robot.joint_names != trained.robot.joint_names:
            seen = f"the model was trained on joints {', '.join(trained.robot.joint_names)}"
            other = f"the other robot has {', '.join(model.robot.joint_names)}"
            raise InvalidInput(f"{seen}; {other}. Forces can move to robots with the same joints only.")
        if self.carries_known_forces and not model.robot.tree.equals(trained.robot.tree):
            held = "gravity and inertia of the robot that it was trained on and cannot move to another"
            seen = f"the mean has no rigid bodies, so the processes hold {held}"
            raise InvalidInput(f"{seen}; fit a model with RigidBodies().")
        # asks for the frames, at a state where a surface is likely to have a normal
        q, v, u = (x[:1].to(model.robot.device) for x in (self.training.q, self.training.v, self.training.u))
        u = u.new_zeros(1, model.sizes[2]) if len(u[0]) != model.sizes[2] else u
        self.trained.unknown.direction(model.dynamics(q, v, u))
        # the training rows are always conditioned in their own system: nothing is factorised again, no number changes
        # widths of intervals of motions were found in the system before
        kept = {name: value for name, value in self.settings.items() if name != "motion_intervals"}
        there = list[Force]()
        for force in trained.unknown_forces:
            with suppress(InvalidInput):  # without its contact a force is zero
                force.check(model.robot, model.contacts)
                there.append(force)
        return replace(self, target=replace(model, forces=(*model.laws, *there), noise=trained.noise), settings=kept)

    def with_contacts(self, contacts: Sequence[Contact | Sequence[Contact]]) -> "Posterior":
        """The same knowledge under other contacts, without another fit: another surface, or none at all, `[]`.

        Forces of a contact follow the contact with their number. Raises InvalidInput as `with_model`.
        """
        return self.with_model(self.model.known.with_contacts(contacts))

    def to(self, device: torch.device | str) -> "Posterior":
        """The same, conditioned on another device, such as "cuda". InvalidInput for one that is not there."""
        model = self.trained.to(device)
        at: torch.device = model.robot.device
        result = replace(self.result, parameters={name: x.to(at) for name, x in self.result.parameters.items()})
        learned = self.training.to(at), {name: value.to(at) for name, value in self.hyperparameters.items()}, result
        there = Posterior.conditioned(model, *learned, self.settings, self.engine, self.estimates)
        there = there if self.target is None else there.with_model(self.target.to(device))
        return there.with_settings(**self.settings)

    def with_settings(self, **settings: Any) -> "Posterior":
        """The same posterior with more entries in `settings`."""
        return replace(self, settings={**self.settings, **settings})
