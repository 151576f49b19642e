"""`StructuredGP`: Gaussian processes on the unknown forces inside known constrained rigid-body dynamics."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from torch import Tensor
from typing_extensions import override

from forcegp.data import Dataset, WeakForm, Windows, farthest_rows
from forcegp.errors import DataWarning, InvalidInput, require_type
from forcegp.inference import Engine, Exact, OptimizationResult, OptimizerOptions, engine_of
from forcegp.models.identification.identification import Identification
from forcegp.models.identification.physical_parameters import PHYSICAL, Learned, learn_to_list
from forcegp.models.observed_wrench import in_air, unobserved
from forcegp.models.search import (
    ALL_ROWS,
    MOST_POINTS_FOR_RESTARTS,
    FitProgress,
    checked_rows,
    described_rows,
    learns_noise,
    noise_of_windows,
    resolved_noise,
    training_rows,
    with_steps_before,
)
from forcegp.models.structured.marginal_likelihood import StructuredModel
from forcegp.models.structured.physical_start import physical_start
from forcegp.models.structured.posterior import StructuredPosterior
from forcegp.models.structured.prior_checks import check_distance, check_prior, warn_of_contacts, warn_of_imitations
from forcegp.models.structured.refinement import (
    fit_with_refined_loads,
    independent_rows,
    learning_rows,
    on_all_rows,
    require_memory_to_learn,
)
from forcegp.models.structured.search import LOG_VARIANCE_SPREAD, FitObjective, Search, with_variance_priors
from forcegp.models.structured.widening import widened
from forcegp.models.training_data import TrainingData
from forcegp.parallel import Backend, backend_for
from forcegp.priors import ForcePrior
from forcegp.priors.named import described_prior

CONTINUE_FROM = (250, 500)
"""Rows of the searches, one after the other, at whose end one on more than `MOST_POINTS_FOR_RESTARTS` rows begins."""


@dataclass(frozen=True, eq=False)
class StructuredGP(StructuredModel):
    """a = M^-1 Q_b + H (Q_K + B f) + noise with f ~ GP (Rath et al. 2021, eq. 6; eq. 7 with the analytical mean).

    Three ways to learn: `fit` from rows of accelerations, `fit_windows` from raw positions or velocities, `identify`
    with physical parameters (masses, friction coefficients) beside the unknown forces.

    Parameters
    ----------
    system: robot, contacts and known forces, for example `dataset.system`.
    prior: the unknown force Q_U = B f; the default is one Gaussian process per joint on (q, v, u).
    mean: "analytical" keeps the known forces Q_K in the mean; "zero" drops them, so that the processes carry Q_K + Q_U.
    noise: measurement noise, a `Noise` or just its standard deviation. None takes `dataset.noise_std`, and raises if
        the dataset does not state it: then pass `Noise(0.1, learn=True)` to learn it. Where the dataset states the
        noise of every row, the level given or learned here is its root mean square over the training rows.
    """

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
        engine: Engine | str = "auto",
        learning_points: int | None = None,
        progress: FitProgress | None = None,
    ) -> StructuredPosterior:
        """Find all kernel and learned noise parameters by marginal likelihood, then condition on the points.

        Parameters
        ----------
        dataset: rows with the joints of the robot in its order; nothing in it is changed.
        points: train on this many rows, chosen by farthest-point sampling of (q, v, u); None takes all rows.
        restarts: number of starts; the first uses moments of the data, the others multiply these by seeded random
            factors, every other one from a smoother start; the best final value wins, and by default starts that fall
            behind two earlier ones are dropped (`settings["restart_status"]`). None means 4 up to 400 points, where
            local optima cost most and searches cost little, and 1 beyond, which then begins where searches on 250 and
            500 of the rows ended.
        seed: of the random factors; restart k uses (seed, k), so its result does not depend on how many there are.
        jobs: restarts at once; None is 1, or as many as the backend can. Results do not depend on it.
        backend: where restarts run: `Serial()`, `Joblib(jobs)`, a `Backend` of your own, or a name, "serial", "joblib".
            None is this process for one job and processes of this machine for several.
        hyperprior: maximise the marginal likelihood times the priors that kernels and learned noise carry (type-II
            maximum a posteriori), which keeps few points calibrated; False is plain type-II maximum likelihood.
        options: the search itself; None is `models.search.default_options`, which is content sooner beyond 400 points.
        start: unconstrained parameters at which the first search begins instead of moments, for example
            `posterior.parameters` of a fit to fewer points; those that are missing start from moments.
        engine: how the posterior is computed from all points: "exact", "inducing", or one of
            `forcegp.inference.ENGINES` with its settings; "auto" chooses by their number, the features and the free
            memory, with the reason in `settings["engine_reason"]`.
        learning_points: find the parameters on this many of the points, those that lie farthest apart; None means all
            up to 1500 and 600 beyond. The posterior is that of all points.
        progress: called as progress(restart, iteration, nll) where the restarts run in this process. The restart is
            `models.search.ALL_ROWS` while the engine takes in all points.

        Where the prior has a friction that is proportional to the normal force, and no `expected` friction is given,
        the fit is repeated with the normal force under the friction that was found, until it settles.

        Raises
        ------
        InvalidInput: the dataset does not fit the system, or an argument is out of range.
        ContactError: a contact cannot hold at some row, or no row touches its surface.
        FitError: no restart could be evaluated; the message names the cause.
        NotEnoughMemory: the engine, or the likelihood of the learning points, would need more than is free.
        NumericalError: the engine failed, for example to reach its tolerance.
        """
        search = Search(backend_for(backend, jobs), restarts, seed, hyperprior, options, start, progress)
        return self._fit_rows(dataset, points, search, engine, learning_points)

    def fit_windows(
        self,
        dataset: Dataset,
        observe: WeakForm,
        *,
        points: int | None = None,
        restarts: int | None = None,
        seed: int = 0,
        jobs: int | None = None,
        backend: Backend | str | None = None,
        hyperprior: bool = True,
        options: OptimizerOptions | None = None,
        start: Mapping[str, Tensor] | None = None,
        progress: FitProgress | None = None,
    ) -> StructuredPosterior:
        """Learn from windows of raw positions or velocities instead of `a` (docs/how-to/without-accelerations.md).

        Parameters
        ----------
        dataset: raw, and at the rate of its sensors.
        observe: `WeakForm(seconds=0.1)`.
        points: train on this many windows, those that lie farthest apart; None takes all. Inference is exact.

        The noise is that of a window's weighted mean acceleration; a model without `noise` learns it, from where the
        noise of the sensors puts it. All other arguments, and what is raised, as for `fit`.
        """
        search = Search(backend_for(backend, jobs), restarts, seed, hyperprior, options, start, progress)
        return self._fit_windows(dataset, observe, points, search)

    def identify(
        self,
        dataset: Dataset,
        learn: Learned | Sequence[Learned],
        *,
        observe: WeakForm | None = None,
        prior_strength: float = 0.0,
        points: int | None = None,
        restarts: int | None = None,
        seed: int = 0,
        jobs: int | None = None,
        backend: Backend | str | None = None,
        hyperprior: bool = True,
        options: OptimizerOptions | None = None,
        start: Mapping[str, Tensor] | None = None,
        engine: Engine | str = "auto",
        learning_points: int | None = None,
        progress: FitProgress | None = None,
    ) -> StructuredPosterior:
        """Estimate physical parameters along with the unknown forces, from the values that the system has.

        Afterwards `posterior.system` has the estimates, and `posterior.identification` their standard errors.

        Parameters
        ----------
        learn: `robot.link("tool").inertial("mass", "com")`, `Coefficients("viscous-joint-friction")`, or several.
        observe: learn from windows as in `fit_windows`; None learns from accelerations.
        prior_strength: weight w of the prior on learned inertias, w/2 times the squared distance of pseudo-inertias
            (`objective.squared_distance`) from the given ones: a body with all masses (1 + x) times as large costs
            2 w x^2. 0 is no prior.
        hyperprior: as for `fit`; the variances of the processes have a weak one as well
            (`objective.with_variance_priors`).
        restarts: draw kernel parameters only; all begin at the same physical values.
        learning_points: None means all points, since standard errors are those of the rows that were learned from.

        All other arguments, and what is raised, as for `fit`. Loads of friction under load are not refined.
        """
        how = (restarts, seed, hyperprior, options, start, progress, learn, prior_strength)
        search = Search(backend_for(backend, jobs), *how)
        if observe is None:
            return self._fit_rows(dataset, points, search, engine, learning_points)
        if not isinstance(engine_of(engine) or Exact(), Exact) or learning_points is not None:
            raise InvalidInput(
                "engine and learning_points are for rows with accelerations; windows (observe=...) are conditioned on "
                "exactly, and all are learned from: leave both out, and give fewer points if it takes too long"
            )
        return self._fit_windows(dataset, observe, points, search)

    @override
    def condition(
        self,
        training: TrainingData,
        parameters: Mapping[str, Tensor],
        result: OptimizationResult,
        settings: Mapping[str, Any],
        engine: Engine | None = None,
        solution: Tensor | None = None,
    ) -> StructuredPosterior:
        """The posterior at given parameters, without optimisation; names as in `MarginalLikelihood`."""
        likelihood = self.likelihood(replace(training, correlated_rows=settings.get("correlated_rows", 1.0)))
        kernels = likelihood.kernels()
        engine = engine or Exact()
        # now: a failure belongs to the fit, not to the first prediction
        latent = likelihood.condition(kernels, parameters, engine, start=solution)
        return StructuredPosterior(self, likelihood, kernels, dict(parameters), result, dict(settings), latent, engine)

    def _fit_rows(
        self, dataset: Dataset, points: int | None, search: Search, engine: Engine | str, learning_points: int | None
    ) -> StructuredPosterior:
        """From accelerations: parameters from some of the rows, the posterior from all."""
        dataset = checked_rows(self.system.robot.joint_names, dataset)
        plain = unobserved(self.system)
        if len(plain.inputs) < len(self.system.inputs) and dataset.u.shape[1] == len(plain.inputs):
            return replace(self, system=plain)._fit_rows(dataset, points, search, engine, learning_points)
        if found := in_air(self.prior, self.system, dataset):
            settings, prior, rows = found
            seeing = replace(self, prior=prior, system=rows.system)
            learned = seeing._fit_rows(rows, points, search, engine, learning_points)
            return learned.with_system(unobserved(learned.system)).with_settings(**settings)
        chosen = engine_of(engine)
        all_rows = training_rows(self.system.robot.joint_names, dataset, points)
        if chosen is not None:
            # now, not after the search
            chosen.require_memory(self.problem_size(len(all_rows)), self.system.robot.device)
        if search.learn is not None and learning_points is None:
            learning_points = len(all_rows)
        ordered = len(all_rows) < len(dataset)
        rows = independent_rows(all_rows) if learns_noise(self.noise, dataset) else all_rows
        if points is not None:  # which rows these are is not the caller's choice
            all_rows = rows
        rows = learning_rows(rows, learning_points, ordered=ordered)
        described = described_rows(all_rows, dataset)
        search = replace(search, start=self._continuation(rows, dataset, search))
        fitted = widened(self._fit_with_loads(rows, dataset, search), search.hyperprior)
        warn_of_contacts(self.system, dataset)  # last: what refuses the rows comes first
        report = None if search.progress is None else partial(search.progress, ALL_ROWS)
        return on_all_rows(fitted, all_rows, chosen, described, search.hyperprior, report)

    def _fit_windows(
        self, dataset: Dataset, observe: WeakForm, points: int | None, search: Search
    ) -> StructuredPosterior:
        """From windows: parameters and the posterior from all of them."""
        windows = require_type("observe", observe, WeakForm).windows(
            checked_rows(self.system.robot.joint_names, dataset), points
        )
        model = replace(self, noise=noise_of_windows(self.noise, windows))
        fitted = model._fit_with_loads(windows, dataset, search)
        reason = f"exact: from {len(windows)} windows of {windows.weights.shape[1]} nodes"
        described = {"observe": dict(windows.nodes.metadata["windows"]), "learning_points": len(windows)}
        return widened(fitted, search.hyperprior).with_settings(
            **described, engine=Exact().to_dict(), engine_reason=reason
        )

    def _continuation(self, rows: Dataset, dataset: Dataset, search: Search) -> Mapping[str, Tensor] | None:
        """Where a single search on many rows begins: at the end of searches on fewer of them."""
        given = search.start is not None or search.learn is not None
        if given or len(rows) <= MOST_POINTS_FOR_RESTARTS or search.restarts not in (None, 1):
            return search.start
        _, options = search.resolved(len(rows))
        stages = [stage for stage in CONTINUE_FROM if 1.5 * stage < len(rows)]
        ordered = farthest_rows(rows, stages[-1])
        start: Mapping[str, Tensor] | None = None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # the fit to all rows gives it
            for stage in stages:
                begin = replace(search, restarts=1, start=start, options=options)
                start = self._fit(ordered.rows(slice(stage)), dataset, begin).parameters
        return start

    def _fit_with_loads(self, rows: Dataset | Windows, dataset: Dataset, search: Search) -> StructuredPosterior:
        """One search or, unless physical parameters are learned, more under the normal force that friction changes."""
        first = self._fit(rows, dataset, search)
        if search.learn is not None:
            return first

        def again(prior: ForcePrior, last: StructuredPosterior) -> StructuredPosterior:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DataWarning)  # the first fit gave it, of the same rows
                begin = replace(search, restarts=1, start=last.parameters)
                return replace(self, prior=prior)._fit(rows, dataset, begin)

        return fit_with_refined_loads(first, again)

    def _fit(self, rows: Dataset | Windows, dataset: Dataset, search: Search) -> StructuredPosterior:
        """One search on these rows or windows of the dataset with the prior as it is, and the exact posterior there."""
        fitted = replace(self, noise=resolved_noise(self.noise, rows))
        training, noise = TrainingData.of(rows, self.system.robot.device), fitted.known_noise
        likelihood = fitted.likelihood(training)
        self.system.check_states(training.q, training.v, training.u)
        check_distance(self.system, training)
        check_prior(likelihood)
        require_memory_to_learn(likelihood)
        described = described_rows(rows, dataset) | {"mean": self.mean, "noise": noise.to_dict()}
        described["prior"] = described_prior(self.prior)  # before the search: a prior of one's own may fail there
        learned_noise, fixed = fitted.split_noise
        if search.learn is None:
            kernels = likelihood.kernels()
            objective = FitObjective(likelihood, kernels, noise, fixed, search.hyperprior)
            result, of_search = search.best(
                objective, search.starts(kernels.initial_parameters() | learned_noise, fixed)
            )
            return fitted.condition(training, result.parameters | fixed, result, {**described, **of_search})
        confounded = warn_of_imitations(likelihood, search.learn)
        strength = search.prior_strength
        physical, kernels, path = physical_start(search.learn, likelihood, learned_noise | fixed, strength)
        kernels = with_variance_priors(kernels) if search.hyperprior else kernels
        objective = FitObjective(likelihood, kernels, noise, fixed, search.hyperprior, physical, strength)
        result, of_search = search.best(objective, search.starts(path[-1] | learned_noise, fixed), keep_iterates=True)
        # the steps before the search are its first iterations
        result = with_steps_before(result, objective, [point | learned_noise for point in path[:-1]])
        settings = described | {
            **of_search,
            "learned": learn_to_list(physical),
            "prior_strength": strength,
            "log_variance_spread": LOG_VARIANCE_SPREAD if search.hyperprior else None,
        }
        history = tuple(physical.named(point[PHYSICAL]) for point in result.iterates)
        found = physical, objective, result.parameters, history
        identification = Identification(*found, training.q.numel(), confounded)
        parameters = {name: value for name, value in result.parameters.items() if name != PHYSICAL}
        result = replace(result, parameters=parameters)
        fitted = replace(fitted, system=identification.system)
        posterior = fitted.condition(training, parameters | fixed, result, settings)
        return replace(posterior, identification=identification)
