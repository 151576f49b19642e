"""`fit`: the numbers and functions of a model, found from a log; the one entry for every kind of evidence."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from forcegp.data import Dataset, farthest_rows
from forcegp.data.dataset import require_rows
from forcegp.data.views import decided, past_known, with_memory
from forcegp.doubts import Doubts
from forcegp.errors import DataWarning, InvalidInput, require_type, usable_arguments
from forcegp.evidence import Evidence, Motions, Sensor, Torques, TrainingData
from forcegp.evidence.likelihood import MarginalLikelihood, check_distance, problem_size
from forcegp.evidence.parameter_space import ParameterSpace
from forcegp.fit import doubts as checked
from forcegp.fit import refinement as refining
from forcegp.fit import search as searching
from forcegp.fit.friction_choice import with_friction_chosen
from forcegp.fit.joint import CHANGE, MOST_ROUNDS, FreeNumbers, estimates_beside, numbers_beside, with_free_numbers
from forcegp.fit.motion_fit import refine_on_motions
from forcegp.fit.payloads import with_payloads_placed
from forcegp.fit.physical import fit_physical, typical_sizes
from forcegp.fit.sensors import usual_evidence, with_sensors
from forcegp.fit.unseen import Unseen
from forcegp.forces import UnknownForces
from forcegp.forces.kernels import LOG_VARIANCE_SPREAD
from forcegp.inference import Engine, OptimizationResult, OptimizerOptions, engine_of
from forcegp.model import Model
from forcegp.parallel import checked_jobs
from forcegp.posterior import Posterior
from forcegp.posterior.drift import with_drift
from forcegp.posterior.fitted import Estimates
from forcegp.posterior.observed_wrench import in_air, unobserved
from forcegp.robots.arguments import whole_number

CONTINUE_FROM = (250, 500)
"""Rows of the searches, one after the other, at whose end one on more than `MOST_POINTS_FOR_RESTARTS` rows begins."""

LEFT_OUT = 0.02
"""Largest share of the rows that is left out since they do not know the past of friction: waiting joints have more."""


@usable_arguments("fit")
def fit(
    model: Model,
    dataset: Dataset,
    evidence: Evidence | Sequence[Evidence] | None = None,
    *,
    baseline: Dataset | None = None,
    points: int | None = None,
    rows: int | None = None,
    restarts: int | None = None,
    seed: int = 0,
    jobs: int | Executor = 1,
    options: OptimizerOptions | None = None,
    start: Mapping[str, Tensor] | Posterior | None = None,
    engine: Engine | str = "auto",
    learning_points: int | None = None,
) -> Any:
    """Find what a model leaves open, from a log: coefficients of laws, bodies and payloads, and unknown functions.

    Numbers are found by Gauss-Newton steps, kernels and noise by marginal likelihood times their priors; where both are
    open, each kernel at its best numbers. `posterior.parameters["viscous.joint_1"]`, `posterior.predict(q, v, u)`.

    Parameters
    ----------
    model: what is known, for example `dataset.model.with_forces(JointFriction())`. Laws without numbers are estimated.
    dataset: rows with the joints of the robot in its order; nothing in it is changed.
    evidence: `Accelerations()` or `Torques()`, and beside it `Motions(seconds)`, which refines what it found. None
        stands for accelerations where functions are unknown, else for torques, with noisy accelerations where the base
        moves or an IMU is there; and for all IMUs and force sensors at contacts, `FrameAcceleration`, `ContactForces`.
    baseline: a second log, of the same robot without the payloads that are estimated.
    points: learn functions from this many rows, those that lie farthest apart in (q, v, u); None: all.
    rows: of models without unknown functions, use so many at most, evenly spread; None: 5,000, fewer beyond 8 joints.
    restarts: number of starts, the first from moments of the data; None: 4 up to 400 points, and 1 beyond. Starts that
        fall behind two earlier ones are dropped (`settings["restart_status"]`).
    seed: of the random starts; restart k uses (seed, k).
    jobs: restarts at once, in as many processes, or a `concurrent.futures.Executor`. Results do not depend on it.
    options: the search itself; None is `fit.search.default_options`.
    start: `posterior.hyperparameters` at which the first search begins; with `Motions` alone, the posterior to refine.
    engine: "exact", "inducing", one of `forcegp.inference.ENGINES` with its settings, or "auto", with the reason in
        `settings["engine_reason"]`.
    learning_points: find the hyper-parameters on this many of the points; None: all up to 1500, and 600 beyond.

    How far it is, `forcegp.progress.watched` hears.

    Gear friction without a stated `memory` gets the parts that held-out stretches of the log show at each joint
    (`settings["gear_friction"]`). Where friction remembers, rows in which a joint has hardly moved since its episode
    began are left out (`settings["rows_before_a_past"]`): what it remembers there, no log tells. Warns (DataWarning)
    where these are too many, and where the friction turns over less than the step of an encoder, or at a bound.

    Friction in proportion to the normal force, with no `expected` one, is fitted again until that force settles.

    Raises
    ------
    InvalidInput: the dataset does not fit the model, forces look alike, or an argument is out of range.
    DatasetError: a log is too short for a payload.
    ContactError: a contact cannot hold at some row, or no row touches its surface.
    FitError: no restart could be evaluated; the message names the cause.
    NotEnoughMemory: the engine, or the likelihood of the learning points, would need more than is free.
    NumericalError: the engine failed.
    """
    require_type("model", model, Model, ", for example dataset.model")
    require_type("dataset", dataset, Dataset, "; the model comes first, as in fit(model, dataset)")
    rest, refinement, sensors = _chosen(evidence, model, dataset, start)
    everything = points is not None and points == len(dataset)
    dataset = _checked(model, dataset, rest, refinement)
    dataset, model = with_sensors(dataset, model, rest, sensors)
    model = checked.without_idle_offsets(model, dataset)
    model, choice = (model, None) if isinstance(start, Posterior) else with_friction_chosen(model, dataset, rest)
    dataset = dataset if choice is None else with_memory(dataset, model)
    known = past_known(dataset, model)
    doubts = list(checked.doubts_of_past(model, dataset, known))
    known = known | (known.mean() < 1.0 - LEFT_OUT)
    points = int(known.sum()) if everything else points  # all of them are all that are left
    dataset = dataset if known.all() else dataset.rows(np.flatnonzero(known))
    touches = (model.contacts or dataset.measured) and not model.carries_known_forces
    unseen = Unseen.of(model, dataset, typical_sizes(model, [dataset])["force"]) if touches else None
    logs = [dataset]
    if baseline is not None:
        logs.append(with_sensors(_checked(model, baseline, rest, None), model, rest, sensors)[0])
    if isinstance(start, Posterior):
        posterior: Any = start
    elif (isinstance(rest, Torques) or not model.unknown_forces) and (model.is_open or model.unknown_forces):
        if model.unknown_forces:
            raise InvalidInput(
                "torques are evidence for numbers of laws and bodies; functions are learned from accelerations, with "
                "noise of the forces (Noise(None, force=..., learn=True)), which is the same likelihood."
            )
        posterior = _of_numbers(model, logs, rest, rows, seed)
    else:
        if baseline is not None:
            raise InvalidInput("a baseline is for payloads, without unknown functions; leave one of them out.")
        search = searching.Search(checked_jobs(jobs), restarts, seed, options, start)
        posterior = _Functions(model, search, engine, learning_points, unseen).fitted(dataset, points)
    if choice is not None:
        posterior = posterior.with_settings(gear_friction=choice.to_dict())
    if not known.all():
        posterior = posterior.with_settings(rows_before_a_past=int((~known).sum()))
    if unseen is not None and not posterior.is_black_box:
        posterior = posterior.with_settings(**unseen.stated)
    if refinement is not None:
        posterior = refine_on_motions(posterior, decided(dataset), refinement.seconds, refinement.bodies, model)
    Doubts([*doubts, *checked.doubts_of_reversals(posterior.model, dataset)]).warn(stacklevel=3)
    return with_drift(posterior, dataset)


def _chosen(
    evidence: Evidence | Sequence[Evidence] | None, model: Model, dataset: Dataset, start: Any
) -> tuple[Any, Motions | None, tuple[Sensor, ...]]:
    """The evidence to begin with, the motions that refine what it found, and sensors beside it."""
    given = () if evidence is None else (evidence,) if isinstance(evidence, Evidence) else tuple(evidence)
    if not all(isinstance(each, Evidence) for each in given):
        raise InvalidInput(f"evidence is {evidence!r}; give Accelerations(), Torques(), ContactForces() or Motions(S).")
    motions = [each for each in given if isinstance(each, Motions)]
    sensors = tuple(each for each in given if isinstance(each, Sensor))
    others = [each for each in given if not isinstance(each, Motions | Sensor)]
    if len(motions) > 1 or len(others) > 1:
        seen = f"evidence is {', '.join(map(str, given))}: the same rows twice"
        raise InvalidInput(f"{seen}; give accelerations or torques, and motions beside them if these shall refine it.")
    refinement = motions[0] if motions else None
    if refinement is not None:
        refinement.refuse(start.trained.unknown_forces if isinstance(start, Posterior) else model.unknown_forces)
    if isinstance(start, Posterior) and (refinement is None or others):
        raise InvalidInput("start is a posterior; it is refined by Motions() alone: give that as the evidence.")
    usual = usual_evidence(model, dataset)
    own = tuple(each for each in usual if isinstance(each, Sensor) and not given)
    return (others or usual)[0], refinement, sensors or own


def _checked(model: Model, dataset: Dataset, evidence: Any, refinement: Motions | None) -> Dataset:
    """The log, if it has what the evidence needs; of equal rows, or episodes of rows in order, the first alone."""
    require_rows("dataset", dataset, model.robot.joint_names, "the robot")
    dataset = dataset if isinstance(evidence, Torques) else decided(dataset)
    if len(dataset) < 2:
        raise InvalidInput(f"the dataset has {len(dataset)} rows; at least 2 are needed")
    for each in (evidence, refinement):
        if each is not None:
            each.check(dataset)
    dataset = with_memory(dataset, model)
    _, first = np.unique(np.hstack([dataset.q, dataset.v, dataset.u, dataset.a]), axis=0, return_index=True)
    again = ~np.isin(np.arange(len(dataset)), first)
    if refinement is not None or model.memory.names:
        for number in dataset.episodes:
            again[dataset.episode == number] &= again[dataset.episode == number].all()
    if not again.any():
        return dataset
    warnings.warn(
        f"{again.sum()} of {len(dataset)} rows equal another one and count once: a row written twice is "
        "no second measurement.",
        DataWarning,
        stacklevel=4,
    )
    return dataset.rows(np.flatnonzero(~again))


def _of_numbers(model: Model, logs: Sequence[Dataset], evidence: Any, rows: int | None, seed: int) -> Posterior:
    if rows is not None:
        whole_number("rows", rows, 1)
    checked.refuse_what_has_no_answer(model)
    found = fit_physical(model, logs, evidence, rows)
    trained, training = replace(found.model, noise=found.noise), TrainingData.of(found.rows, model.robot.device)
    result = OptimizationResult({}, found.history[-1], found.history, "Gauss-Newton steps", found.estimates.settled,
                                found.estimates.evaluations, 0.0)  # fmt: skip
    settings = {"seed": seed, "evidence": str(evidence), "noise": found.noise.to_dict(), "doubts": list(found.doubts)}
    settings = searching.described_rows(found.rows, logs[0]) | settings
    noise = found.noise.parameters(model.robot.nv, model.robot.device)
    return Posterior.conditioned(trained, training, noise, result, settings, estimates=found.estimates)


@dataclass(frozen=True, eq=False)
class _Functions:
    """How unknown functions are learned, and numbers beside them."""

    model: Model
    search: searching.Search
    engine: Engine | str
    learning_points: int | None
    unseen: Unseen | None = None
    """What the log leaves open of forces at contacts."""

    def fitted(self, dataset: Dataset, points: int | None) -> Posterior:
        """In the air of the log, where that moves."""
        plain = unobserved(self.model)
        if len(plain.inputs) < len(self.model.inputs) and dataset.u.shape[1] == len(plain.inputs):
            return replace(self, model=plain).fitted(dataset, points)
        if found := in_air(self.model, dataset):
            settings, seen = found
            learned: Any = replace(self, model=seen.model).fitted(replace(seen, model=seen.model.known), points)
            return learned.with_model(unobserved(learned.model)).with_settings(**settings)
        return self._of_rows(dataset, points)

    def _of_rows(self, dataset: Dataset, points: int | None) -> Posterior:
        """From accelerations: hyper-parameters from some of the rows, the posterior from all."""
        chosen, all_rows = engine_of(self.engine), dataset
        if points is not None:
            points = whole_number("points", points, 2, len(dataset), "the rows of the dataset")
            all_rows = dataset if points == len(dataset) else farthest_rows(dataset, points)
        if chosen is not None:
            # now, not after the search
            chosen.require_memory(problem_size(self.model, len(all_rows)), self.model.robot.device)
        ordered = len(all_rows) < len(dataset)
        rows = refining.independent_rows(all_rows) if searching.learns_noise(self.model.noise, dataset) else all_rows
        if points is not None:  # which rows these are is not the caller's choice
            all_rows = rows
        rows = refining.learning_rows(rows, self.learning_points, ordered=ordered)
        described = searching.described_rows(all_rows, dataset)
        own = replace(self, search=replace(self.search, start=self._continuation(rows, dataset)))
        fitted = searching.widened(own._with_numbers(rows, dataset))
        checked.warn_of_contacts(self.model, dataset)  # last: what refuses the rows comes first
        return refining.on_all_rows(fitted, with_memory(all_rows, fitted.model), chosen, described)

    def _continuation(self, rows: Dataset, dataset: Dataset) -> Mapping[str, Tensor] | None:
        """Where a single search on many rows begins: at the end of searches on fewer of them."""
        search = self.search
        if (
            search.start is not None
            or len(rows) <= searching.MOST_POINTS_FOR_RESTARTS
            or search.restarts not in (None, 1)
        ):
            return search.start
        _, options = search.resolved(len(rows))
        stages = [stage for stage in CONTINUE_FROM if 1.5 * stage < len(rows)]
        ordered = farthest_rows(rows, stages[-1])
        start: Mapping[str, Tensor] | None = None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # the fit to all rows gives it
            for stage in stages:
                closed = replace(self, search=replace(search, restarts=1, start=start, options=options))
                start = closed._search(ordered.rows(slice(stage)), dataset).hyperparameters
        return start

    def _with_numbers(self, rows: Dataset, dataset: Dataset) -> Posterior:
        """Searches for functions with numbers of laws and bodies free, where these are open."""
        if not self.model.is_open:
            return self._with_loads(rows, dataset)
        checked.refuse_what_has_no_answer(self.model)
        space = ParameterSpace(with_payloads_placed(self.model, [dataset]), typical_sizes(self.model, [rows]))
        x = space.start
        again, found, change, rounds = self, None, np.inf, 0
        while rounds < MOST_ROUNDS and change >= CHANGE:
            with warnings.catch_warnings():
                if rounds:
                    warnings.simplefilter("ignore", DataWarning)  # the first search gave it, of the same rows
                posterior = again._beside_numbers(rows, dataset, space, x)
            again = replace(self, search=replace(self.search, restarts=1, start=posterior.hyperparameters))
            x, found, change = numbers_beside(posterior, space, x)
            rounds += 1
        assert found is not None, "there was a round"
        posterior = again._beside_numbers(rows, dataset, space, x)
        estimates = replace(estimates_beside(space, found, len(rows)), settled=change < CHANGE)
        return replace(posterior, estimates=estimates).with_settings(rounds=rounds)

    def _beside_numbers(self, rows: Dataset, dataset: Dataset, space: ParameterSpace, x: np.ndarray) -> Posterior:
        here = replace(space.model_at(x), noise=self.model.noise)
        return replace(self, model=here)._search(
            with_memory(rows, here), dataset, lambda given: with_free_numbers(given, space, x)
        )

    def _with_loads(self, rows: Dataset, dataset: Dataset) -> Posterior:
        def again(forces: UnknownForces, last: Posterior) -> Posterior:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DataWarning)  # the first fit gave it, of the same rows
                begin = replace(self.search, restarts=1, start=last.hyperparameters)
                model = replace(self.model, forces=(*self.model.laws, *forces.terms))
                return replace(self, model=model, search=begin)._search(rows, dataset)

        return refining.fit_with_refined_loads(self._search(rows, dataset), again)

    def _search(
        self, rows: Dataset, dataset: Dataset, beside: Callable[[MarginalLikelihood], FreeNumbers] | None = None
    ) -> Posterior:
        """One search on these rows with this model, and its posterior; `beside` gives a likelihood of numbers."""
        noise = searching.resolved_noise(self.model.noise, rows)
        noise = noise if self.unseen is None else self.unseen.with_pushes(noise, len(rows))
        model = replace(self.model, noise=noise)
        training = TrainingData.of(rows, model.robot.device, rows.measured)
        likelihood = MarginalLikelihood(model, training)
        model.check_states(training.q, training.v, training.u)
        check_distance(model, training)
        checked.check_forces(likelihood)
        refining.require_memory_to_learn(likelihood)
        described = searching.described_rows(rows, dataset) | {"noise": noise.to_dict()}
        learned_noise, fixed = likelihood.split_noise
        kernels = likelihood.kernels
        if beside is not None:
            kernels, described["log_variance_spread"] = searching.with_variance_priors(kernels), LOG_VARIANCE_SPREAD
        objective = searching.FitObjective(likelihood if beside is None else beside(likelihood), kernels, noise, fixed)
        starts = self.search.starts(kernels.initial_parameters() | learned_noise, fixed)
        result, of_search = self.search.best(objective, starts)
        found = result.parameters | fixed, result, {**described, **of_search}
        return Posterior.conditioned(model, training, *found, estimates=Estimates())
