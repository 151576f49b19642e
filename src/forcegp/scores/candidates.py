"""The models of a comparison: each is fitted to the same training rows, or was fitted before.

A name is FORCES[@EVIDENCE], both as for `forcegp fit` but joined by "+": forces that are found beside those of the
robot as given, or beside those of the robot as `identified`, such as gp:joint-friction, viscous+gp:joint,
identified+gp:joint-friction@accelerations+motions:1. Laws alone are found from all training rows, as identified is.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from forcegp.data import Dataset, thruster_columns
from forcegp.errors import FitError, InvalidInput
from forcegp.evidence import Accelerations, Evidence, Motions, Torques, parse_evidence
from forcegp.fit import fit, held_out_noise
from forcegp.forces import IndependentAccelerations, JointAccelerations, has_few_inputs
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior.posterior import Posterior
from forcegp.scores.learning import learn, named_model, summands, usual_evidence, usual_forces
from forcegp.scores.scores import Kind

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


@dataclass(frozen=True)
class Candidate:
    """One model of a comparison.

    Fields
    ------
    summary: what it is, for the page.
    kind: parametric (`given`, `identified`), `residual`, `black box` or `force prior`.
    fit: makes the posterior; or the posterior that was fitted before.
    identification: the name of the identification that it builds on, see `identified_model`; None for none.
    all_rows: whether it learns from all training rows alone, so that one seed stands for all.
    digest: what its result depends on beside its name and its code.
    """

    summary: str
    kind: Kind
    fit: Callable[[Training], Posterior] | Posterior
    identification: str | None = None
    all_rows: bool = False
    digest: str = ""


Given = str | Model | Posterior | Candidate | Callable[[Training], Posterior]
"""What may be scored: a name, a model to fit, a posterior as it is, or a function of yours that fits."""


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
    on_forces = [f"{IDENTIFIED}+gp:{name}" for name in ("joint-accelerations", "joint", "joint-friction")]
    refined = (f"{IDENTIFIED}{moved}", f"{on_forces[-1]}{moved}") if moved else ()
    return GIVEN, IDENTIFIED, *refined[:1], "gp:independent", *on_forces, *refined[1:]


def candidates(given: Mapping[str, Given] | Sequence[str], model: Model, identification: str) -> dict[str, Candidate]:
    """The models of a comparison by name, `identified` always among them.

    Raises InvalidInput for none, for a name that comes twice, for names that are none, and for forces that do not fit.
    """
    if not given:
        raise InvalidInput("no model is named; name one or more.")
    repeated = sorted({name for name in given if list(given).count(name) > 1})
    if repeated:
        raise InvalidInput(f"models {repeated} are named twice; name each once.")
    wanted: dict[str, Given] = dict(given) if isinstance(given, Mapping) else {name: name for name in given}
    wanted = wanted if IDENTIFIED in wanted else {IDENTIFIED: IDENTIFIED, **wanted}
    return {name: candidate(name, each, model, identification) for name, each in wanted.items()}


def candidate(name: str, given: Given, model: Model, identification: str) -> Candidate:
    """One of them. `identification` is what `identified` stands for, itself such a name."""
    if isinstance(given, str):
        return _named_candidate(name, given, model, identification)
    if isinstance(given, Posterior):
        return fitted_before(given)
    if isinstance(given, Model):
        kind, few = kind_of(given), bool(given.unknown_forces) and has_few_inputs(given.unknown, given.robot)
        every = few or (given.is_open and not given.unknown_forces)
        work = partial(_fit_model, given, (), ())
        return Candidate("a model of yours", kind, work, all_rows=every, digest=_digest(given))
    if isinstance(given, Candidate):
        return given
    if not callable(given):
        raise InvalidInput(
            f"model {name!r} is a {type(given).__name__}; give a name, a Model, a Posterior or a function."
        )
    return Candidate("a model of yours", "force prior", given)


def fitted_before(posterior: Posterior) -> Candidate:
    """A posterior as it is, which is fitted to nothing here."""
    training = posterior.training
    numbers = [*(getattr(training, name) for name in ("q", "v", "u")), *posterior.hyperparameters.values()]
    digest = _digest(posterior.model.known, *(each.detach().cpu().numpy().tobytes() for each in numbers))
    kind, summary = kind_and_summary(posterior)
    return Candidate(summary, kind, posterior, all_rows=True, digest=digest)


def kind_and_summary(posterior: Posterior) -> tuple[Kind, str]:
    """What a posterior is."""
    kind = kind_of(getattr(posterior, "trained", posterior.model), bool(posterior.parameters))
    return kind, f"{posterior.description}, fitted before to {len(posterior.training)} rows"


def kind_of(model: Model, identified: bool = False) -> Kind:
    """Which questions a model answers."""
    if any(isinstance(force, IndependentAccelerations) for force in model.unknown_forces):
        return "black box"
    if any(isinstance(force, JointAccelerations) for force in model.unknown_forces):
        return "residual"
    return "force prior" if model.unknown_forces else "identified" if identified or model.is_open else "given"


def _digest(model: Model, *parts: bytes) -> str:
    digest = hashlib.sha256(model.to_json().encode())
    for part in parts:
        digest.update(part)
    return digest.hexdigest()


def _named_candidate(name: str, expression: str, model: Model, identification: str) -> Candidate:
    words, motions, others = _parts(expression)
    forces = "+".join(words)
    on_identified, words = words[0] == IDENTIFIED, words[words[0] == IDENTIFIED :]
    try:
        described = named_model(model, words or (GIVEN,))
    except InvalidInput as error:
        known = f"{GIVEN}, {IDENTIFIED} or FORCES[@EVIDENCE]"
        raise InvalidInput(f"no model is called {name!r}; give {known} ({error})") from None
    unknown, opened = described.unknown_forces, described.is_open and not model.is_open
    if opened and not unknown and on_identified:
        raise InvalidInput(f"model {name!r}: `identified` has its laws already; name all laws, or leave these out.")
    key = None
    if opened and not unknown:
        on_identified, key, words = True, EVIDENCE.join([forces, *_texts(others)]), ()
    elif on_identified:
        own, _, usual = identification.partition(EVIDENCE)
        key = EVIDENCE.join([own, *(_texts(others) if others and not unknown else [usual])])
    if motions and not on_identified and not unknown:
        raise InvalidInput(f"model {name!r} has nothing to refine on motions; add forces.")
    summary = {
        "black box": "one Gaussian process per joint on (q, v, u), without physics",
        "residual": f"one Gaussian process per joint on the acceleration ({' + '.join(words)})",
        "force prior": f"Gaussian processes on unknown forces ({' + '.join(words)})",
        "identified": "identified from ALL training rows, noise from training rows held out",
        "given": "the model as given, noise learned",
    }
    kind = kind_of(described, on_identified) if unknown or on_identified else "given"
    few = bool(unknown) and has_few_inputs(described.unknown, model.robot)
    where = f", beside {key}" if key and words else f": {key}" if key else ""
    refined = "; refined on the motions of all training rows" if motions else ""
    return Candidate(
        f"{summary[kind]}{where}{refined}",
        kind,
        partial(_fit_named, words, on_identified, others if unknown else (), motions),
        key,
        all_rows=few or (key is not None and not unknown),
    )


def _parts(name: str) -> tuple[tuple[str, ...], tuple[Evidence, ...], tuple[Evidence, ...]]:
    """Forces, evidence of motions, and other evidence of a name."""
    forces, _, words = name.partition(EVIDENCE)
    try:
        evidence = parse_evidence(list(summands(words))) if words else ()
    except InvalidInput as error:
        raise InvalidInput(f"model {name!r}: {error}") from None
    motions = tuple(each for each in evidence if isinstance(each, Motions))
    return summands(forces), motions, tuple(each for each in evidence if each not in motions)


def _texts(evidence: Sequence[Evidence]) -> list[str]:
    """Evidence as it is written, one for all or none."""
    texts = []
    for each in evidence:
        given = [f"{key}={value}" for key, value in vars(each).items() if value != getattr(type(each), key)]
        texts.append(":".join([each.name, *given]))
    return ["+".join(texts)] if texts else []


def _fit_named(
    words: Sequence[str], on_identified: bool, others: Sequence[Evidence], motions: Sequence[Evidence], given: Training
) -> Posterior:
    base = given.base(on_identified)
    model = named_model(base, words or (GIVEN,), base.noise)
    few = bool(model.unknown_forces) and has_few_inputs(model.unknown, model.robot)
    if kind_of(model) == "black box":
        model = replace(model, noise=Noise(None, learn=True))
    elif few and on_identified:
        # held-out noise contains the misfit that the forces are to learn; so many rows show their own
        assert model.noise is not None, "it was given"
        model = replace(model, noise=replace(model.noise, learn=True))
    return _fit_model(model, others, motions, given)


def _fit_model(model: Model, others: Sequence[Evidence], motions: Sequence[Evidence], given: Training) -> Posterior:
    """The posterior: functions of few inputs and laws from all rows, motions from the whole recording."""
    few = bool(model.unknown_forces) and has_few_inputs(model.unknown, model.robot)
    every = few or (model.is_open and not model.unknown_forces)
    rows = given.all_rows if every else given.rows
    how: dict[str, Any] = {"seed": given.seed, "restarts": given.restarts}
    how |= {"iterations": None} if few else {"iterations": given.iterations, "points": len(given.rows)}
    posterior: Any = learn(model, rows, others, **how)[0]
    return fit(posterior.model, given.recording, motions, start=posterior) if motions else posterior


def checked_identification(name: str, model: Model) -> tuple[Model, Accelerations | Torques]:
    """The model that is open where laws and bodies of this name are, and the evidence. Raises InvalidInput."""
    words, _, evidence = _parts(name)
    opened = named_model(model, words)
    if opened.unknown_forces or not opened.is_open:
        raise InvalidInput(f"identification {name!r} has nothing to identify, or unknown forces; name laws and bodies.")
    chosen = evidence[0] if evidence else usual_evidence(opened)
    if not isinstance(chosen, Accelerations | Torques):
        raise InvalidInput(f"identification {name!r} is from {chosen.name}; give accelerations or torques.")
    return opened, chosen


def identified_model(name: str, model: Model, rows: Dataset) -> tuple[Model, list[str]]:
    """The model that laws and bodies of this name make of these rows, with the noise of rows that are held out.

    And the rotors that no row shows, whose inertias are those of the prior.
    """
    opened, evidence = checked_identification(name, model)
    found: Any = fit(opened, rows, evidence)
    unseen = [name for name, each in found.estimates.items() if name.startswith("rotor") and each.decided_by == "prior"]
    return replace(found.model, noise=held_out_noise(opened, rows, evidence)), unseen
