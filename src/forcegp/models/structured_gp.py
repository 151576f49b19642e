"""`StructuredGP`: Gaussian processes on the unknown forces inside known constrained rigid-body dynamics."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, get_args

from torch import Tensor

from forcegp.data import Dataset, WindowObservation, Windows, farthest_rows
from forcegp.errors import DataWarning, InvalidInput
from forcegp.inference import (
    Engine,
    Exact,
    LatentKernels,
    OptimizationResult,
    OptimizerOptions,
    ProblemSize,
    engine_of,
)
from forcegp.mechanics import MechanicalSystem
from forcegp.models.fit_arguments import (
    check_search_numbers,
    described_rows,
    first_start,
    noise_of_windows,
    resolved_noise,
    training_rows,
    training_windows,
)
from forcegp.models.identification import Identification
from forcegp.models.load_refinement import fit_with_refined_loads
from forcegp.models.many_rows import learning_rows, on_all_rows, require_memory_to_learn
from forcegp.models.marginal_likelihood import MarginalLikelihood, Mean, TrainingData
from forcegp.models.noise import Noise
from forcegp.models.objective import LOG_VARIANCE_SPREAD, FitObjective, with_variance_priors
from forcegp.models.physical_parameters import PHYSICAL, Learned, learn_to_list
from forcegp.models.physical_start import PhysicalStart
from forcegp.models.prior_checks import check_prior
from forcegp.models.protocol import Model
from forcegp.models.search import (
    ALL_ROWS,
    MOST_POINTS_FOR_RESTARTS,
    FitProgress,
    default_options,
    default_restarts,
    with_steps_before,
)
from forcegp.models.structured_posterior import StructuredPosterior
from forcegp.models.structured_search import StructuredSearch
from forcegp.models.surface_distance import check_distance
from forcegp.parallel import Backend, backend_for
from forcegp.priors import ForcePrior, JointForces, prior_to_dict

CONTINUE_FROM = (250, 500)
"""Rows of the searches, one after the other, at whose end one on more than `MOST_POINTS_FOR_RESTARTS` rows begins."""


@dataclass(frozen=True, eq=False)
class StructuredGP(Model):
    """a = M^-1 Q_b + H (Q_K + B f) + noise with f ~ GP (Rath et al. 2021, eq. 6; eq. 7 with the analytical mean).

    Parameters
    ----------
    system: robot, contacts and known forces, for example `dataset.system`.
    prior: the unknown force Q_U = B f; the default is one Gaussian process per joint on (q, v, u).
    mean: "analytical" keeps the known forces Q_K in the mean; "zero" drops them, so that the processes carry Q_K + Q_U.
    noise: measurement noise, a `Noise` or just its standard deviation. None takes `dataset.noise_std`, and raises if
        the dataset does not know it: then pass `Noise(0.1, learn=True)` to learn it. Where the dataset states the noise
        of every row, the level given or learned here is its root mean square over the training rows.
    """

    # This constructor is the check, with messages for people; run-time checks of annotations must not come before it.
    __no_type_check__: ClassVar[bool] = True

    system: MechanicalSystem
    prior: ForcePrior = field(default_factory=JointForces)
    mean: Mean = "analytical"
    noise: Noise | None = None

    def __post_init__(self) -> None:
        for name, kind in (("system", MechanicalSystem), ("prior", ForcePrior)):
            if not isinstance(getattr(self, name), kind):
                given = type(getattr(self, name)).__name__
                raise InvalidInput(f"{name} is a {given}; give a {kind.__name__}, for example system=dataset.system")
        if self.noise is not None and not isinstance(self.noise, Noise):
            object.__setattr__(self, "noise", Noise(self.noise))
        if self.mean not in get_args(Mean):
            raise InvalidInput(f"mean is {self.mean!r}; allowed: {', '.join(map(repr, get_args(Mean)))}")
        self.prior.check(self.system)

    def fit(
        self,
        dataset: Dataset,
        *,
        points: int | None = None,
        restarts: int | None = None,
        seed: int = 0,
        jobs: int | None = None,
        backend: Backend | str | None = None,
        hyperprior: bool = True,
        options: OptimizerOptions | None = None,
        start: Mapping[str, Tensor] | None = None,
        learn: Learned | Sequence[Learned] | None = None,
        prior_strength: float = 0.0,
        engine: Engine | str = "auto",
        learning_points: int | None = None,
        observe: WindowObservation | str | None = None,
        progress: FitProgress | None = None,
    ) -> StructuredPosterior:
        """Find all kernel and learned noise parameters by marginal likelihood, then condition on the points.

        Parameters
        ----------
        dataset: rows with the joints of the robot in its order; nothing in it is changed.
        points: train on this many rows, chosen by farthest-point sampling of (q, v, u); None takes all rows.
        restarts: number of starts; the first uses moments of the data, the others multiply these by seeded random
            factors, every other one from a smoother start; the best final value wins. None means 4 up to 400 points,
            where local optima cost most and searches cost little, and 1 beyond, which then begins where searches on
            250 and 500 of the rows ended. They draw kernel parameters only: all begin at the same physical values.
        seed: of the random factors; restart k uses (seed, k), so its result does not depend on how many there are.
        jobs: restarts at once; None is 1, or as many as the backend can. Results do not depend on it.
        backend: where restarts run: `Serial()`, `Joblib(jobs)`, `Ray(address)` or a name, "serial", "joblib", "ray"
            (docs/clusters.md). None is this process for one job and processes of this machine for several.
        hyperprior: maximise the marginal likelihood times the priors that kernels and learned noise carry (type-II
            maximum a posteriori), which keeps few points calibrated; False is plain type-II maximum likelihood. With
            `learn` the variances of the processes have a weak one as well (`models.objective.with_variance_priors`).
        options: the search itself; None is `models.search.default_options`, which is content sooner beyond 400 points.
        start: unconstrained parameters at which the first search begins instead of moments, for example
            `posterior.parameters` of a fit to fewer points; those that are missing start from moments.
        learn: physical parameters to estimate along with all others, from the values that the system has:
            `robot.link("tool").inertial("mass", "com")`, `Coefficients("viscous-joint-friction")`, or several of them.
            Then `posterior.system` has the estimates, and `posterior.identification` tells all about them.
        prior_strength: weight w of the prior on learned inertias, w/2 times the squared distance of pseudo-inertias
            (`models.objective.squared_distance`) from the given ones: a body with all masses (1 + x) times as large
            costs 2 w x^2. 0 is no prior.
        engine: how the posterior is computed from all points: "exact", "iterative", "inducing", or one of
            `forcegp.inference.ENGINES` with its settings; "auto" chooses by their number, the features and the free
            memory, and says why in `settings["engine_reason"]`.
        learning_points: find the parameters on this many of the points, those that lie farthest apart; None means all
            up to 1500 and 600 beyond, with `learn` all. The posterior is that of all points.
        observe: what to learn from instead of the column `a`, of a dataset that is raw and at the rate of its sensors:
            `WeakForm(seconds=0.1)`, `VelocityIncrements(seconds=0.1)` or the name of one. Then points are windows,
            inference is exact, and the noise is that of a window's weighted mean acceleration; without `noise` it is
            learned, from where the noise of the sensors puts it (docs/without-accelerations.md).
        progress: called as progress(restart, iteration, nll) where the restarts run in this process. The restart is
            `models.search.ALL_ROWS` while the engine takes in all points.

        Where the prior has a friction that is proportional to the normal force, and no `expected` friction is given,
        the fit is repeated with the normal force under the friction that was found, until it settles (not with
        `learn`).

        Raises
        ------
        InvalidInput: the dataset does not fit the system, or an argument is out of range.
        ContactError: a contact cannot hold at some row, or no row touches its surface.
        FitError: no restart could be evaluated; the message names the cause.
        NotEnoughMemory: the engine, or the likelihood of the learning points, would need more than is free.
        NumericalError: the engine failed, for example to reach its tolerance.
        """
        chosen = engine_of(engine)
        how: dict[str, Any] = {"seed": seed, "hyperprior": hyperprior, "options": options, "progress": progress}
        how["backend"] = backend_for(backend, jobs)
        if observe is not None:
            if not isinstance(chosen or Exact(), Exact) or learning_points is not None:
                raise InvalidInput(
                    "engine and learning_points are for rows with accelerations; windows (observe=...) are conditioned "
                    "on exactly, and all are learned from: leave both out, and give fewer points if it takes too long"
                )
            windows = training_windows(self.system.robot.joint_names, dataset, points, observe)
            return self._fit_windows(windows, dataset, restarts, start, learn, prior_strength, how)
        all_rows = training_rows(self.system.robot.joint_names, dataset, points)
        if chosen is not None:
            chosen.require_memory(self._size(len(all_rows)), self.system.robot.device)  # now, not after the search
        if learn is not None and learning_points is None:
            learning_points = len(all_rows)  # standard errors are those of the rows that were learned from
        rows = learning_rows(all_rows, learning_points, ordered=len(all_rows) < len(dataset))
        if start is None and learn is None:
            start = self._continuation(rows, dataset, restarts, how)
        first = self._fit(rows, dataset, restarts, start, learn, prior_strength, **how)
        if learn is None:
            first = self._with_refined_loads(first, rows, dataset, how)
        report = None if progress is None else partial(progress, ALL_ROWS)
        return on_all_rows(first, all_rows, chosen, described_rows(all_rows, dataset), hyperprior, report)

    def _fit_windows(
        self,
        windows: Windows,
        dataset: Dataset,
        restarts: int | None,
        start: Mapping[str, Tensor] | None,
        learn: Learned | Sequence[Learned] | None,
        prior_strength: float,
        how: Mapping[str, Any],
    ) -> StructuredPosterior:
        """`fit` to these windows of the dataset."""
        model = replace(self, noise=noise_of_windows(self.noise, windows))
        fitted = model._fit(windows, dataset, restarts, start, learn, prior_strength, **how)
        if learn is None:
            fitted = model._with_refined_loads(fitted, windows, dataset, how)
        reason = f"exact: from {len(windows)} windows of {windows.weights.shape[1]} nodes"
        said = {"observe": dict(windows.nodes.metadata["windows"]), "learning_points": len(windows)}
        return fitted.with_settings(**said, engine=Exact().to_dict(), engine_reason=reason)

    def _size(self, rows: int) -> ProblemSize:
        """Of the posterior of so many rows, without computing anything; contacts count as independent."""
        nv, latents = self.system.robot.nv, len(self.prior.latent_names(self.system.robot))
        return ProblemSize(rows, nv, min(latents, nv - len(self.system.contacts)), latents, 0)

    def _continuation(
        self, rows: Dataset, dataset: Dataset, restarts: int | None, how: Mapping[str, Any]
    ) -> dict[str, Tensor] | None:
        """Where a single search on many rows begins: at the end of searches on fewer of them; None for few rows."""
        if len(rows) <= MOST_POINTS_FOR_RESTARTS or restarts not in (None, 1):
            return None
        options = how["options"] or default_options(len(rows))
        stages = [stage for stage in CONTINUE_FROM if 1.5 * stage < len(rows)]
        ordered = farthest_rows(rows, stages[-1])
        start = None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # the fit to all rows will say it
            for stage in stages:
                begin = {**how, "options": options}
                start = dict(self._fit(ordered.rows(slice(stage)), dataset, 1, start, None, 0.0, **begin).parameters)
        return start

    def _with_refined_loads(
        self, first: StructuredPosterior, rows: Dataset | Windows, dataset: Dataset, how: Mapping[str, Any]
    ) -> StructuredPosterior:
        """`first`, or a fit with the normal force under the friction that was found."""

        def again(prior: ForcePrior, last: StructuredPosterior) -> StructuredPosterior:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DataWarning)  # the first fit has said it of the same rows
                return replace(self, prior=prior)._fit(rows, dataset, 1, last.parameters, None, 0.0, **how)

        return fit_with_refined_loads(first, again)

    def _fit(
        self,
        rows: Dataset | Windows,
        dataset: Dataset,
        restarts: int | None,
        start: Mapping[str, Tensor] | None,
        learn: Learned | Sequence[Learned] | None,
        prior_strength: float,
        *,
        seed: int,
        backend: Backend,
        hyperprior: bool,
        options: OptimizerOptions | None,
        progress: FitProgress | None,
    ) -> StructuredPosterior:
        """`fit` to these rows or windows of the dataset with the prior as it is."""
        noise = resolved_noise(self.noise, rows)
        restarts = default_restarts(len(rows)) if restarts is None else restarts
        check_search_numbers(restarts, seed)
        if not 0.0 <= prior_strength < float("inf"):
            raise InvalidInput(f"prior_strength is {prior_strength}; it must be finite and at least 0")
        training = TrainingData.of(rows, self.system.robot.device)
        likelihood = self._likelihood(training)
        self.system.check_states(training.q, training.v, training.u)
        check_distance(self.system, training)
        check_prior(likelihood)
        require_memory_to_learn(likelihood)
        noise_parameters = noise.parameters(self.system.robot.nv, self.system.robot.device)
        learned_noise, fixed = (noise_parameters, {}) if noise.learn else ({}, noise_parameters)
        begin = None if learn is None else PhysicalStart.of(learn, likelihood, noise_parameters, prior_strength)
        kernels = likelihood.kernels() if begin is None else begin.kernels
        if begin is not None and hyperprior:
            kernels = with_variance_priors(kernels)
        moments = (kernels.initial_parameters() if begin is None else begin.path[-1]) | learned_noise
        options = options or default_options(len(rows))
        if PHYSICAL in (start or {}):
            raise InvalidInput(
                f"start has {PHYSICAL!r}, numbers in units that the data of their own fit gave them; leave it out, and "
                "give the model the system whose values the search shall start from, as in "
                "StructuredGP(posterior.system)"
            )
        first = first_start(moments, start or {}, fixed)
        physical = None if begin is None else begin.physical
        objective = FitObjective(likelihood, kernels, noise, fixed, hyperprior, physical, prior_strength)
        kept = options if begin is None else replace(options, keep_iterates=True)
        search = StructuredSearch(objective, moments, first, seed, kept)
        result, values = search.best(restarts, backend, progress)
        if begin is not None:  # the steps before the search are its first iterations
            result = with_steps_before(result, objective, [point | learned_noise for point in begin.path[:-1]])
        settings = {
            **described_rows(rows, dataset),
            "restarts": restarts,
            "warm_start": start is not None,
            "seed": seed,
            "mean": self.mean,
            "prior": prior_to_dict(self.prior),
            "noise": noise.to_dict(),
            "noise_from_data": not noise.learn and (self.noise is None or self.noise.acceleration is None),
            "optimizer": {name: getattr(options, name) for name in options.__dataclass_fields__},
            "hyperprior": hyperprior,
            "restart_objective": values,
        }
        fitted = StructuredGP(self.system, self.prior, self.mean, noise)
        if begin is None:
            return fitted._posterior(likelihood, kernels, result.parameters | fixed, result, settings)
        settings |= {"learned": learn_to_list(begin.physical), "prior_strength": prior_strength}
        settings["log_variance_spread"] = LOG_VARIANCE_SPREAD if hyperprior else None
        identification = Identification.of(begin.physical, objective, result)
        parameters = {name: value for name, value in result.parameters.items() if name != PHYSICAL}
        posterior = replace(fitted, system=identification.system).condition(
            training, parameters | fixed, replace(result, parameters=parameters), settings
        )
        return replace(posterior, identification=identification)

    def condition(
        self,
        training: TrainingData,
        parameters: Mapping[str, Tensor],
        result: OptimizationResult,
        settings: Mapping[str, Any],
        solution: Tensor | None = None,
    ) -> StructuredPosterior:
        """The posterior at given parameters, without optimisation; names as in `MarginalLikelihood`."""
        likelihood = self._likelihood(training)
        return self._posterior(likelihood, likelihood.kernels(), parameters, result, settings, solution)

    def parameter_shapes(self, training: TrainingData) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the kernel and noise parameters that a posterior on these points needs."""
        noise = (self.noise or Noise()).parameters(self.system.robot.nv)
        named = self._likelihood(training).kernels().initial_parameters() | noise
        return {name: tuple(value.shape) for name, value in named.items()}

    def _posterior(
        self,
        likelihood: MarginalLikelihood,
        kernels: LatentKernels,
        parameters: Mapping[str, Tensor],
        result: OptimizationResult,
        settings: Mapping[str, Any],
        solution: Tensor | None = None,
    ) -> StructuredPosterior:
        posterior = StructuredPosterior(self, likelihood, kernels, dict(parameters), result, dict(settings))
        # now: a failure belongs to the fit, not to the first prediction
        vars(posterior)["latent"] = likelihood.condition(kernels, parameters, posterior.engine, start=solution)
        return posterior

    def _likelihood(self, training: TrainingData) -> MarginalLikelihood:
        return MarginalLikelihood(self.system, self.prior, self.mean, training)
