"""The models of a comparison, by name: each is fitted to the same training rows.

A name is FORCES[@EVIDENCE], both as for `forcegp fit` but joined by "+": forces that are found beside those of the
robot as given, or beside those of the robot as `identified`, such as gp:joint-friction, viscous+gp:joint,
identified+gp:joint-friction@accelerations+motions:1. Laws alone are found from all training rows, as identified is. Add
yours:

    CANDIDATES["mine"] = Candidate("what it is", "black box", fit_mine)
"""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, get_args

from forcegp.data import Dataset, thruster_columns
from forcegp.errors import FitError, InvalidInput
from forcegp.evaluation import learn, named_model, summands, usual_evidence, usual_forces
from forcegp.evidence import Accelerations, Evidence, Motions, Torques, Windows, parse_evidence
from forcegp.fit import fit, held_out_noise
from forcegp.forces import IndependentAccelerations, JointAccelerations, has_few_inputs
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior import Posterior

Kind = Literal["given", "identified", "residual", "black box", "force prior"]
"""Parametric physics as given or identified, a Gaussian process on what it leaves of the acceleration, a model without
physics, and Gaussian processes on unknown forces.
"""

GIVEN, IDENTIFIED, EVIDENCE = "given", "identified", "@"
USUAL = "bodies+viscous+coulomb+rotor"
"""Forces that are identified where nothing else is asked for."""


@dataclass(frozen=True, eq=False)
class Training:
    """What a model is fitted to.

    Fields
    ------
    rows: the training rows, the same for every model of a seed.
    given: the model as it was given.
    all_rows: all training rows, and `recording`, the same at the full rate.
    identified: the model identified from all training rows with its noise; a text where that failed, None where nothing
        was asked for.
    seed: of the search.
    restarts, iterations: of the search for hyper-parameters; None leaves them to the model.
    """

    rows: Dataset
    given: Model
    all_rows: Dataset
    recording: Dataset
    identified: Model | str | None = None
    seed: int = 0
    restarts: int | None = None
    iterations: int | None = None

    def base(self, identified: bool) -> Model:
        """The model as given or identified, with its noise. Raises FitError where the identification has failed."""
        if not identified:
            return replace(self.given, noise=Noise(None, learn=True))
        if not isinstance(self.identified, Model):
            raise FitError(f"the identification that it rests on failed: {self.identified}")
        return self.identified

    @property
    def search(self) -> dict[str, Any]:
        """Of `learn`."""
        return {"seed": self.seed, "restarts": self.restarts, "iterations": self.iterations}


@dataclass(frozen=True)
class Candidate:
    """One model of a comparison.

    Fields
    ------
    summary: what it is, for the page.
    kind: which questions it answers.
    fit: makes the posterior.
    identification: the name of the identification that it builds on, see `identified_model`; None for none.
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


CANDIDATES: dict[str, Candidate] = {}
"""Models of your own by name."""


def usual_identification(model: Model) -> str:
    """What `identified` is where nothing else is asked for; a body without joints has no friction in them."""
    forces = USUAL if model.robot.single_joint_names else "bodies"
    return f"{forces}{EVIDENCE}{'accelerations' if model.robot.space.is_vector_space else 'torques:both'}"


def default_models(model: Model) -> tuple[str, ...]:
    """Models that are compared where none is named: without refinements on motions where the base moves.

    Regression takes air for inertia, and a body without joints has no friction: both learn on the robot as given.
    """
    if thruster_columns(model) or not model.robot.single_joint_names:
        return GIVEN, IDENTIFIED, "gp:independent", "gp:joint-accelerations", usual_forces(model)
    moved = f"{EVIDENCE}motions:1" if model.robot.space.is_vector_space else ""
    forces = ("joint-accelerations", "joint", "joint-friction")
    on_forces = [f"{IDENTIFIED}+gp:{name}" for name in forces]
    refined = (f"{IDENTIFIED}{moved}", f"{on_forces[-1]}{moved}") if moved else ()
    return GIVEN, IDENTIFIED, *refined[:1], "gp:independent", *on_forces, *refined[1:]


def candidate(name: str, model: Model, identification: str) -> Candidate:
    """The model of this name. `identification` is what `identified` stands for, itself such a name.

    Raises InvalidInput for names that are none, and for forces that do not fit the model.
    """
    if name in CANDIDATES:
        return CANDIDATES[name]
    forces, at, evidence_words = name.partition(EVIDENCE)
    words, evidence = summands(forces), _evidence(name, summands(evidence_words) if at else ())
    motions, others = _motions_apart(evidence)
    on_identified, words = words[0] == IDENTIFIED, words[words[0] == IDENTIFIED :]
    try:
        described = named_model(model, words or (GIVEN,))
    except InvalidInput as error:
        close = difflib.get_close_matches(name, [*CANDIDATES, GIVEN, IDENTIFIED], n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise InvalidInput(f"no model is called {name!r}; {hint}give FORCES[@EVIDENCE] ({error})") from None
    opened = described.is_open and not model.is_open
    unknown = described.unknown_forces
    if opened and not unknown and on_identified:
        raise InvalidInput(f"model {name!r}: `identified` has its laws already; name all laws, or leave these out.")
    key = None
    if opened and not unknown:
        on_identified, key, words = True, EVIDENCE.join([forces, *_named(others)]), ()
    elif on_identified:
        own, _, usual = identification.partition(EVIDENCE)
        key = EVIDENCE.join([own, *(_named(others) if others and not unknown else [usual])])
    if motions and not on_identified and not unknown:
        raise InvalidInput(f"model {name!r} has nothing to refine on motions; add forces.")
    kind, summary = _kind(described, words, on_identified)
    few = bool(unknown) and has_few_inputs(described.unknown, model.robot)
    where = f", beside {key}" if key and words else f": {key}" if key else ""
    refined = "; refined on the motions of all training rows" if motions else ""
    return Candidate(
        f"{summary}{where}{refined}",
        kind,
        partial(_fit, words, on_identified, others if unknown else (), motions),
        key,
        cost=(10.0 if unknown else 1.0) * (5.0 if motions else 1.0),
        all_rows=few or (key is not None and not unknown),
    )


def _evidence(name: str, words: Sequence[str]) -> tuple[Evidence, ...]:
    try:
        return parse_evidence(list(words)) if words else ()
    except InvalidInput as error:
        raise InvalidInput(f"model {name!r}: {error}") from None


def _motions_apart(evidence: Sequence[Evidence]) -> tuple[tuple[Evidence, ...], tuple[Evidence, ...]]:
    motions = tuple(each for each in evidence if isinstance(each, Motions))
    return motions, tuple(each for each in evidence if each not in motions)


def _named(evidence: Sequence[Evidence]) -> list[str]:
    """Evidence as it is written, one for all or none."""
    texts = []
    for each in evidence:
        given = [f"{key}={value}" for key, value in vars(each).items() if value != getattr(type(each), key)]
        texts.append(":".join([each.name, *given]))
    return ["+".join(texts)] if texts else []


def _kind(model: Model, words: Sequence[str], on_identified: bool) -> tuple[Kind, str]:
    """Which questions a model answers, and what it is."""
    listed = " + ".join(words)
    if any(isinstance(force, IndependentAccelerations) for force in model.unknown_forces):
        return "black box", "one Gaussian process per joint on (q, v, u), without physics"
    if any(isinstance(force, JointAccelerations) for force in model.unknown_forces):
        return "residual", f"one Gaussian process per joint on the acceleration ({listed})"
    if model.unknown_forces:
        return "force prior", f"Gaussian processes on unknown forces ({listed})"
    if on_identified:
        return "identified", "identified from ALL training rows, noise from training rows held out"
    return "given", "the model as given, noise learned"


def _fit(
    words: Sequence[str], on_identified: bool, others: Sequence[Evidence], motions: Sequence[Evidence], given: Training
) -> Posterior:
    """The posterior of a named model."""
    base = given.base(on_identified)
    model = named_model(base, words or (GIVEN,), base.noise)
    if any(isinstance(force, IndependentAccelerations) for force in model.unknown_forces):
        model = replace(model, noise=Noise(None, learn=True))
    few = bool(model.unknown_forces) and has_few_inputs(model.unknown, model.robot)
    windows = any(isinstance(each, Windows) for each in others)
    if few and on_identified:
        # held-out noise contains the misfit that the forces are to learn; so many rows show their own
        assert model.noise is not None, "it was given"
        model = replace(model, noise=replace(model.noise, learn=True))
    rows = given.recording if windows else given.all_rows if few else given.rows
    how: dict[str, Any] = given.search | ({"iterations": None} if few else {"points": len(given.rows)})
    posterior: Any = learn(model, rows, others, **how)[0]
    return fit(posterior.model, given.recording, motions, start=posterior) if motions else posterior


def checked_identification(name: str, model: Model) -> tuple[Model, Accelerations | Torques]:
    """The model that is open where laws and bodies of this name are, and the evidence. Raises InvalidInput."""
    forces, at, words = name.partition(EVIDENCE)
    _, evidence = _motions_apart(_evidence(name, summands(words) if at else ()))
    opened = named_model(model, summands(forces))
    if opened.unknown_forces or not opened.is_open:
        raise InvalidInput(f"identification {name!r} has nothing to identify, or unknown forces; name laws and bodies.")
    chosen = evidence[0] if evidence else usual_evidence(opened)
    if not isinstance(chosen, Accelerations | Torques):
        raise InvalidInput(f"identification {name!r} is from {chosen.name}; give accelerations or torques.")
    return opened, chosen


def identified_model(name: str, model: Model, rows: Dataset) -> Model:
    """The model that laws and bodies of this name make of these rows, with the noise of rows that are held out.

    Raises InvalidInput for names that are no laws and for too few rows.
    """
    opened, evidence = checked_identification(name, model)
    found: Any = fit(opened, rows, evidence)
    return replace(found.model, noise=held_out_noise(opened, rows, evidence))


def candidates(names: Sequence[str], model: Model, identification: str) -> dict[str, Candidate]:
    """The models of these names. Raises InvalidInput for none, for a name that comes twice, and as `candidate`."""
    if not names:
        raise InvalidInput("no model is named; name one or more.")
    repeated = sorted({name for name in names if list(names).count(name) > 1})
    if repeated:
        raise InvalidInput(f"models {repeated} are named twice; name each once.")
    return {name: candidate(name, model, identification) for name in names}
