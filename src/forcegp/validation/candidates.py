"""The models of a comparison, by name: each fits a posterior to the same training rows.

A name is an entry of `CANDIDATES`, a way to identify the system (`identified-torque`), or an expression of priors as in
`forcegp fit --prior` with the system that its mean takes: `joint-friction` (as given), `joint@identified`. A way to
identify may name friction laws of its own (`identified-torque:viscous,load`), and with `/motions` at its end a model is
refined on the motions of all training rows (docs/how-to/motions.md). Add yours:

    CANDIDATES["mine"] = Candidate("what it is", "black box", fit_mine)
"""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

from forcegp.analytical import NoiseLevels
from forcegp.data import Dataset, thruster_columns
from forcegp.errors import FitError, InvalidInput
from forcegp.evaluation import all_rows_at_once, allowing_for_correlation, usual_prior, with_force_noise
from forcegp.inference import OptimizerOptions
from forcegp.mechanics import MechanicalSystem
from forcegp.models import IndependentGP, Noise, Posterior, StructuredGP
from forcegp.priors import NoForces, has_few_inputs, named_prior
from forcegp.validation.comparison import (
    DEFAULT_IDENTIFICATION,
    IDENTIFICATIONS,
    LAWS_AFTER,
    identification_named,
    resolved_identification,
)

Kind = Literal["given", "identified", "residual", "black box", "force prior"]
"""Parametric physics as given or identified, a Gaussian process on what it leaves of the acceleration, a model without
physics, and Gaussian processes on unknown forces.
"""

MEAN = "@"  # between a prior and the system that the mean takes, in the name of a model
MOTIONS = "/motions"  # at the end of a name: the model refined on motions


@dataclass(frozen=True, eq=False)
class Training:
    """What a model is fitted to.

    Fields
    ------
    rows: the training rows, the same for every model of a seed.
    given: the system as it was given.
    identified: the systems identified from the same rows, by the name of the identification; a text where it
        failed.
    seed: of the search.
    restarts, iterations: of the search for hyper-parameters; None leaves them to the model.
    force_noise: where a learned noise of the joint forces begins [Nm or N]; None is none.
    measured_torque: whether predictions account for the noise of their u (`Noise`).
    levels: the noise about the identified system, where its identification estimates it; else it is learned.
    all_rows: all training rows, for models that can use them.
    recording, seconds: the same at the full rate, and the longest horizon that motions are scored at.
    """

    rows: Dataset
    given: MechanicalSystem
    identified: dict[str, MechanicalSystem | str]
    seed: int = 0
    restarts: int | None = None
    iterations: int | None = None
    force_noise: float | None = None
    measured_torque: bool = False
    levels: NoiseLevels | None = None
    all_rows: Dataset | None = None
    recording: Dataset | None = None
    seconds: float = 1.0

    @property
    def noise(self) -> Noise:
        """Of models with physics."""
        if self.levels is None:
            measured = self.measured_torque and self.force_noise is not None
            return Noise(None, self.force_noise, learn=True, measured_torque=measured)
        acceleration, force = tuple(self.levels.acceleration), tuple(self.levels.force)
        return Noise(acceleration, force, measured_torque=self.measured_torque)

    def system(self, mean: str) -> MechanicalSystem:
        """The system of this name: given, or an identification. Raises FitError where that has failed."""
        if mean == "given":
            return self.given
        found = self.identified[mean]
        if isinstance(found, str):
            raise FitError(f"the {mean} identification that it rests on failed: {found}")
        return found

    @property
    def search(self) -> dict[str, object]:
        """Arguments for the `fit` of a Gaussian process."""
        options = {} if self.iterations is None else {"options": OptimizerOptions(iterations=self.iterations)}
        return {"seed": self.seed, "restarts": self.restarts, **options}


@dataclass(frozen=True)
class Candidate:
    """One model of a comparison.

    Fields
    ------
    summary: what it is, for the page.
    kind: which questions it answers.
    fit: makes the posterior.
    identification: the one that it builds on, see `identification_named`; None for none.
    all_rows: whether it learns from all training rows alone, so that one seed stands for all.
    cost: CPU time relative to others, for the remaining time alone.
    """

    summary: str
    kind: Kind
    fit: Callable[[Training], Posterior]
    identification: str | None = None
    cost: float = 1.0
    all_rows: bool = False

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise InvalidInput(f"kind is {self.kind!r}; allowed: {', '.join(get_args(Kind))}.")
        if self.identification is not None:
            identification_named(self.identification)


def _fit_system(mean: str, training: Training) -> Posterior:
    model = StructuredGP(training.system(mean), NoForces(), "analytical", training.noise)
    return model.fit(training.rows, seed=training.seed, restarts=1)  # its starts would all be the same


def _fit_forces(prior: str, mean: str, training: Training) -> Posterior:
    system = training.system(mean)
    forces = named_prior(prior, system)
    if training.all_rows is not None and has_few_inputs(forces, system.robot):
        # held-out noise contains the misfit that the forces are to learn; so many rows show their own
        noise = replace(training.noise, learn=True)
        model = with_force_noise(StructuredGP(system, forces, "analytical", noise), training.all_rows)
        how = all_rows_at_once(len(training.all_rows), system.robot.nv)
        fitted = model.fit(training.all_rows, seed=training.seed, restarts=training.restarts, **how)
        return allowing_for_correlation(fitted, training.all_rows)[0]
    model = StructuredGP(system, forces, "analytical", training.noise)
    return model.fit(training.rows, **training.search)  # type: ignore[arg-type]  # keywords of one dictionary


def _fit_independent(training: Training) -> Posterior:
    model = IndependentGP(training.given, noise=Noise(None, learn=True))
    return model.fit(training.rows, **training.search)  # type: ignore[arg-type]  # keywords of one dictionary


def _fit_motions(fit: Callable[[Training], Posterior], training: Training) -> Posterior:
    assert training.recording is not None, "a comparison gives all training rows"
    return fit(training).refined_on_motions(training.recording, training.seconds)


CANDIDATES: dict[str, Candidate] = {
    "analytical": Candidate(
        "the system as given (URDF and known forces), noise learned", "given", partial(_fit_system, "given")
    ),
    "independent-gp": Candidate(
        "one Gaussian process per joint on (q, v, u), without physics", "black box", _fit_independent, cost=5.0
    ),
}
"""Models by name. Identified systems and Gaussian processes on forces need no entry, see `candidate`."""

IDENTIFIED = "identified-"
RESIDUAL = "joint-accelerations"  # one Gaussian process per joint on the acceleration

DEFAULT_MODELS = (
    "analytical",
    "identified-acceleration-all",
    "identified-acceleration-all/motions",
    "independent-gp",
    f"{RESIDUAL}@identified",
    "joint@identified",
    "joint-friction@identified",
    "joint-friction@identified/motions",
)


def default_models(system: MechanicalSystem) -> tuple[str, ...]:
    """Models that are compared where none is named: without refinements on motions where the base moves.

    Regression takes air for inertia, and a body without joints has no friction: both learn on the robot as given.
    """
    identified = f"{IDENTIFIED}{resolved_identification(DEFAULT_IDENTIFICATION, system)}"
    if thruster_columns(system) or not system.robot.single_joint_names:
        physics = ("analytical", identified)
        return (*physics, "independent-gp", RESIDUAL, usual_prior(system))
    fixed = system.robot.space.is_vector_space
    named = (name.replace(DEFAULT_MODELS[1], identified) for name in DEFAULT_MODELS)
    return tuple(name for name in named if fixed or not name.endswith(MOTIONS))


def candidate(name: str, system: MechanicalSystem, identification: str = DEFAULT_IDENTIFICATION) -> Candidate:
    """The model of this name: an entry, `identified-METHOD`, or Gaussian processes with these priors on forces.

    `identification` is what `@identified` takes. Raises InvalidInput for names that are none of these, and for priors
    that do not fit the system.
    """
    if name in CANDIDATES:
        return CANDIDATES[name]
    if name.endswith(MOTIONS):
        base = candidate(name.removesuffix(MOTIONS), system, identification)
        if base.kind in ("black box", "given"):
            raise InvalidInput(f"model {name!r} has no physics to refine on motions, or is the one that was given.")
        summary = f"{base.summary}; refined on the motions of all training rows"
        return replace(base, summary=summary, fit=partial(_fit_motions, base.fit), cost=5.0 * base.cost)
    if name.startswith(IDENTIFIED) and name.removeprefix(IDENTIFIED).partition(LAWS_AFTER)[0] in IDENTIFICATIONS:
        method = name.removeprefix(IDENTIFIED)
        chosen = identification_named(method)
        noise = "noise learned" if chosen.noise is None else "noise from training rows held out"
        summary = f"the system identified by {chosen.summary}; {noise}"
        return Candidate(summary, "identified", partial(_fit_system, method), method, all_rows=chosen.all_rows)
    expression, at, mean = (part.strip() for part in name.partition(MEAN))
    mean, colon, laws = (mean if at else "given").partition(LAWS_AFTER)
    if mean not in ("given", "identified", *IDENTIFICATIONS) or (colon and mean == "given"):
        allowed = ", ".join(("given", "identified", *IDENTIFICATIONS))
        raise InvalidInput(f"model {name!r} takes its mean from {mean!r}; give PRIOR{MEAN}MEAN with one of {allowed}.")
    method = {"given": None, "identified": resolved_identification(identification, system)}.get(mean, mean)
    method = f"{method}{colon}{laws}" if colon else method
    try:
        prior = named_prior(expression, system)
    except InvalidInput as error:
        known = [*CANDIDATES, *(f"{IDENTIFIED}{method}" for method in IDENTIFICATIONS)]
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise InvalidInput(
            f"no model is called {name!r}; {hint}there are {', '.join(known)}, and priors PRIOR{MEAN}MEAN with the "
            f"mean given or identified ({error})"
        ) from None
    takes = "as given" if method is None else f"identified by {identification_named(method).summary}"
    return Candidate(
        f"Gaussian processes on unknown forces ({expression}), mean of the system {takes}",
        "residual" if expression == RESIDUAL else "force prior",
        partial(_fit_forces, expression, "given" if method is None else method),
        method,
        cost=10.0,
        all_rows=has_few_inputs(prior, system.robot) and (method is None or identification_named(method).all_rows),
    )


def candidates(
    names: Sequence[str], system: MechanicalSystem, identification: str = DEFAULT_IDENTIFICATION
) -> dict[str, Candidate]:
    """The models of these names. Raises InvalidInput for none, for a name that comes twice, and as `candidate`."""
    if not names:
        raise InvalidInput("no model is named; name one or more.")
    repeated = sorted({name for name in names if list(names).count(name) > 1})
    if repeated:
        raise InvalidInput(f"models {repeated} are named twice; name each once.")
    return {name: candidate(name, system, identification) for name in names}
