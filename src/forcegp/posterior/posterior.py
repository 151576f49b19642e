"""What every posterior offers: `fit(model, log) -> posterior`, `posterior.predict(q, v, u)`."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar, TypeVar, overload

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.data import Dataset
from forcegp.errors import InvalidInput, NumericalError, require_type
from forcegp.evidence import Accelerations
from forcegp.evidence.training_data import TrainingData
from forcegp.forces import Force
from forcegp.inference import Engine, LeaveOut, OptimizationResult
from forcegp.integration import Feedback
from forcegp.integration.integrators import check_time_step
from forcegp.mechanics import Baumgarte, ConstrainedDynamics, Contact
from forcegp.model import Model
from forcegp.posterior.components import Components, Curve
from forcegp.posterior.estimates import Estimates
from forcegp.posterior.motion_intervals import MotionIntervals
from forcegp.posterior.prediction import Gaussian, Inputs, Positions, Prediction, Rows, join_predictions
from forcegp.posterior.predictor import Predictor
from forcegp.posterior.rollout import AccelerationFunction, AccelerationModel, Rollout, remembering, roll_out
from forcegp.robots import Robot
from forcegp.robots.arguments import broadcast_batch, real_tensor, require_finite
from forcegp.summary import Summary, rounded

ROWS_PER_BLOCK = 4096
"""States that are predicted at once; bounds the memory of long recordings."""

AnyPosterior = TypeVar("AnyPosterior", bound="Posterior")  # beartype cannot check Self where a module is hooked

Array = Tensor | np.ndarray | Sequence[Any]


class Posterior(Summary, ABC):
    """What a fit has learned of a model, as a frozen value.

    `trained` is the model with the numbers that were found; `hyperparameters` are those of kernels and noise by name;
    `estimates` the numbers of laws and bodies (`parameters`); `settings` is the resolved configuration of the fit
    (plain JSON values), with at least `points` (training rows), `seed` and `data` (metadata and episodes of the
    training data); `result` is the history of the search and why it ended. A subclass is a frozen dataclass with these
    and the abstract members; an entry in `forcegp.posterior.storage.KINDS` lets it be stored.
    """

    trained: Model
    hyperparameters: Mapping[str, Tensor]
    settings: Mapping[str, Any]
    result: OptimizationResult
    estimates: Estimates
    target: Model | None = None
    """The model that predictions are for, where it is not the one that was trained (`with_model`)."""
    engine: Any = None
    """The Engine that computed the posterior, stored with it; None where there is no choice."""

    @property
    def model(self) -> Model:
        """What predictions are for: robot, contacts and forces."""
        return self.trained if self.target is None else self.target

    @property
    def parameters(self) -> Estimates:
        """Numbers of laws and bodies that the fit estimated, with intervals, and whether the log decides them."""
        return self.estimates

    @classmethod
    @abstractmethod
    def conditioned(
        cls: type[AnyPosterior],
        model: Model,
        training: TrainingData,
        hyperparameters: Mapping[str, Tensor],
        result: OptimizationResult,
        settings: Mapping[str, Any],
        engine: Engine | None = None,
        solution: Tensor | None = None,
        estimates: Estimates | None = None,
    ) -> AnyPosterior:
        """The posterior at given hyper-parameters, without a search: what a stored one is loaded with.

        `engine` computes it, where there is a choice; `solution` is what that engine had found (`Posterior.solution`),
        which saves it most of its work.
        """

    @staticmethod
    @abstractmethod
    def parameter_shapes(model: Model, training: TrainingData) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the hyper-parameters that a posterior on these rows needs."""

    @property
    @abstractmethod
    def training(self) -> TrainingData:
        """The rows that the model was trained on."""

    @property
    @abstractmethod
    def noise_std(self) -> Float[Tensor, "nv"]:
        """Standard deviation of the acceleration noise per joint, given, learned or estimated."""

    @cached_property
    @abstractmethod
    def negative_log_likelihood(self) -> float:
        """-log p(a | q, v, u) of the training data at the fitted parameters, in nats, without any hyperprior."""

    @abstractmethod
    def predict_rows(self, q: Positions, v: Rows, u: Inputs, covariance: bool) -> Prediction:
        """`predict` for one block of checked states."""

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
    @abstractmethod
    def description(self) -> str:
        """What kind of model it is, in a few words, for titles and tables."""

    @property
    def motion_intervals(self) -> MotionIntervals | None:
        """Widths of the intervals of motions, where they were calibrated (`forcegp.calibrated`); a rollout has them."""
        return None

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints in the order of every last dimension."""
        return self.model.robot.joint_names

    @property
    def objective(self) -> str:
        """What `result.history` holds, with its unit in brackets."""
        return "negative log likelihood with hyperpriors [nats]"

    predicts_forces: ClassVar[bool] = True
    """Whether predictions hold the forces behind the acceleration."""

    @property
    def carries_known_forces(self) -> bool:
        """Whether the predicted `unknown_force` holds the known forces, too."""
        return False

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
        return predicted if of is None else tuple(self._quantity(each, predicted, q, v, u) for each in of)

    def _quantity(self, of: Any, predicted: Prediction, q: Array, v: Array, u: Array) -> Gaussian:
        """One quantity that is affine in the forces."""
        contacts, forces = list(self.model.contacts), list(self.model.unknown_forces)
        if isinstance(of, Accelerations):
            return predicted.acceleration
        if of in contacts and predicted.contact_force is not None:
            part = slice(3 * contacts.index(of), 3 * contacts.index(of) + 3)
            mean, spread = predicted.contact_force.mean[..., part], predicted.contact_force.covariance
            return Gaussian(mean, None if spread is None else spread[..., part, part])
        if of in forces and self.predicts_forces:
            components = self.components(q, v, u, covariance=predicted.covariance is not None)
            return list(components.values())[forces.index(of)].joint_force
        raise InvalidInput(
            f"of holds {of!r}; give Accelerations(), or a contact or an unknown force of the model that predicts."
        )

    def components(self, q: Array, v: Array, u: Array, *, covariance: bool = True) -> Components:
        """Every force by itself, at states as for `predict`. Raises InvalidInput for models that predict no forces."""
        raise InvalidInput(f"a {self.description} predicts no forces, so it has no components; use a structured model.")

    def curve(self, latent: str, features: Array | None = None, *, points: int = 200) -> Curve:
        """One process of the prior over its features. Raises InvalidInput for models without a prior on forces."""
        raise InvalidInput(f"a {self.description} has no latent forces, so it has no curves; use a structured model.")

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
        raise InvalidInput(
            f"a {self.description} has no predictor for control rates; call predict, or use a structured Gaussian "
            "process."
        )

    def checked_states(self, q: Array, v: Array, u: Array) -> tuple[list[Tensor], torch.Size]:
        """States as rows of float64 tensors on the model's device, and their batch dimensions.

        Raises InvalidInput for wrong shapes or values that are not finite.
        """
        sizes = self.model.sizes
        device = self.model.robot.device
        named = zip("qvu", (q, v, u), sizes, strict=True)
        given = [_tensor(name, values, size, device) for name, values, size in named]
        batch = broadcast_batch(dict(zip("qvu", (x.shape[:-1] for x in given), strict=True)))
        return [x.expand(*batch, -1).reshape(batch.numel(), x.shape[-1]) for x in given], batch

    def accelerations(self, baumgarte: Baumgarte | None) -> AccelerationModel:
        """What `rollout` integrates, under this stabilisation.

        By default the mean of `predict`, from which no functions can be drawn. Raises InvalidInput for a stabilisation
        where the model has no constraint.
        """
        if baumgarte is not None:
            raise InvalidInput(
                f"baumgarte was given, but a {type(self).__name__} has no constraint, so there is "
                "nothing to stabilise; give baumgarte=None, and `integrator='projected'` to stay on the surface."
            )

        def mean() -> AccelerationFunction:
            return lambda q, v, u: self.predict(q, v, u, covariance=False).mean

        def sampled(samples: int, seed: int) -> AccelerationFunction:
            raise InvalidInput(
                f"no functions can be drawn from a {type(self).__name__}; give `samples=0`, or use a structured model."
            )

        return AccelerationModel(self.model, None, mean, sampled)

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
            u = self.model.foreseen(_tensor("u", u, self.model.sizes[2], self.model.robot.device), dt)
        if self.model.memory.names:
            given = _tensor("u", u, self.model.sizes[2], self.model.robot.device)
            u, feedback = remembering(self.model, given, dt, feedback)
        how: dict[str, Any] = {"feedback": feedback, "samples": samples, "seed": seed, "progress": progress}
        moved = roll_out(model, q0, v0, u, dt, integrator=integrator, grad=grad, **how)
        return replace(moved, intervals=self.motion_intervals)

    def leave_out(self, blocks: Sequence[Sequence[int]] | None = None) -> LeaveOut:
        """How well training rows are predicted from those outside their block: in closed form, without another fit.

        `blocks` holds numbers of training rows; None leaves one row out at a time. Rows that follow each other in time
        hold nearly the same information, so leave them out together: `forcegp.data.time_blocks`. The parameters stay
        those that were fitted to all rows, so the scores flatter a model with many of them a little.
        Raises InvalidInput for blocks that overlap, and for models that would have to be trained again.
        """
        raise InvalidInput(
            f"a {self.description} would have to be trained again for every block that is left out; evaluate it on "
            "another recording instead, or use a Gaussian process."
        )

    @property
    def solution(self) -> Tensor | None:
        """What conditioning on these rows again can begin from, stored with the model; None where it is cheap."""
        return None

    def update(self, rows: Dataset, budget: int | None = None) -> "Posterior":
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
        raise InvalidInput(
            f"a {self.description} cannot learn from more rows without another fit: fit it again to all rows, or use "
            "a structured model with engine='exact'."
        )

    def with_model(self: AnyPosterior, model: Model) -> AnyPosterior:
        """The same knowledge in another model (robot, contacts, laws) with the same joints.

        Raises InvalidInput for models that it cannot be carried to: for every one that learned accelerations.
        """
        raise InvalidInput(
            f"a {self.description} learned the accelerations of one robot, contacts included, so it cannot move to "
            "another; fit it to data from there, or use a structured model, which learns forces."
        )

    def with_contacts(self: AnyPosterior, contacts: Sequence[Contact | Sequence[Contact]]) -> AnyPosterior:
        """The same knowledge under other contacts, without another fit: another surface, or none at all, `[]`.

        What was learned of joint forces stays as it is; forces of a contact follow the contact with their number, and
        are zero without it. Raises InvalidInput as `with_model`.
        """
        return self.with_model(self.model.known.with_contacts(contacts))

    def with_robot(self: AnyPosterior, robot: Robot) -> AnyPosterior:
        """The same knowledge on another robot with the same joints, for example with another known tool.

        Raises InvalidInput as `with_model`.
        """
        return self.with_model(self.model.with_robot(robot))

    def to(self: AnyPosterior, device: torch.device | str) -> AnyPosterior:
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
        there = type(self).conditioned(
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

    def with_settings(self: AnyPosterior, **settings: Any) -> AnyPosterior:
        """The same posterior with more entries in `settings`."""
        return replace(self, settings={**self.settings, **settings})  # type: ignore[type-var]  # every posterior is a dataclass


def _all_on(tensors: Mapping[str, Tensor], device: torch.device) -> dict[str, Tensor]:
    return {name: value.to(device) for name, value in tensors.items()}


def _tensor(name: str, values: Array, size: int, device: torch.device) -> Tensor:
    tensor = real_tensor(name, values, device)
    if tensor.dim() == 0 or tensor.shape[-1] != size:
        raise InvalidInput(
            f"{name} has shape {tuple(tensor.shape)}; its last dimension must be {size}, one value per joint."
        )
    require_finite(name, tensor)
    return tensor
