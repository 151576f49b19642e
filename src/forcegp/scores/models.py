"""Models by name, one way to learn them, and the models of a comparison.

A name is FORCES[@EVIDENCE], both as for `forcegp fit` but joined by "+": forces beside those of the robot as given or
as `identified`, such as viscous+gp:joint, identified@accelerations+motions:1.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from forcegp.checks.residuals import pushed_where_they_are
from forcegp.data import Dataset, thruster_columns, with_memory
from forcegp.data.views import decided
from forcegp.errors import FitError, InvalidInput
from forcegp.evidence import Accelerations, Evidence, Motions, Sensor, Torques, parse_evidence
from forcegp.evidence.least_squares import correlation_time
from forcegp.evidence.recorded_rows import slides
from forcegp.fit import calibrated, default_options, fit, held_out_noise
from forcegp.fit.friction_choice import with_choice_of, with_friction_chosen
from forcegp.fit.search import MOST_POINTS_FOR_RESTARTS
from forcegp.fit.sensors import usual_evidence
from forcegp.forces import IndependentAccelerations, JointAccelerations, has_few_inputs, parse_forces, split_outside
from forcegp.inference import Inducing
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior import Posterior
from forcegp.posterior.fitted import HORIZONS
from forcegp.scores.scores import Kind
from forcegp.summary import listed

GIVEN, ONLY, NONE = "given", "only", "none"
"""First words of the forces of a model: those that it has, and none of them; "none" adds nothing."""

POINTS = 200  # rows that functions of many inputs are learned from where nobody says how many
RESIDUALS = 20_000  # rows whose residuals show how long errors resemble each other
NOTICEABLE = 1.5  # rows over which they must to count for less
RESIDUALS_OF_FORCES = 1000  # rows that show where the noise of forces begins


def summands(expression: str) -> tuple[str, ...]:
    """The words between the "+" of an expression that stand outside of parentheses."""
    return tuple(part.strip() for part in split_outside(expression, "+"))


def named_model(model: Model, words: Sequence[str], noise: Noise | None = None) -> Model:
    """The model with forces as commands name them, beside those that it has; laws replace their class.

    A first word "only" leaves out what it has, also gravity and actuation; "given" and "none" add nothing.
    "gp:independent" stands alone, without physics. Raises InvalidInput.
    """
    first, rest = (words[0], words[1:]) if words and words[0] in (GIVEN, ONLY, NONE) else (GIVEN, words)
    if first == NONE and rest:
        raise InvalidInput(f"forces are none and {', '.join(rest)}; leave one of both out.")
    forces = parse_forces(list(rest)) if rest else ()
    if any(isinstance(force, IndependentAccelerations) for force in forces):
        if len(words) > 1:
            raise InvalidInput("gp:independent has no physics, so no other force can stand beside it; leave these out.")
        return model.black_box(noise)
    return (model.without_mean() if first == ONLY else model).with_forces(*forces, noise=noise)


def identify(recording: Dataset, expression: str) -> tuple[str, Posterior]:
    """The robot identified as FORCES@EVIDENCE says, and that expression: with springs where the log asks for them."""
    forces, _, evidence = expression.partition("@")
    given = parse_evidence(evidence)
    identified = learn(named_model(recording.model, summands(forces)), recording, given)[0]
    # sensors that did not teach are no forces beside those that were found: a tool would count twice
    alone = recording if any(isinstance(each, Sensor) for each in given) else replace(recording, measured={})
    pushed = recording.model.robot.space.is_vector_space and "spring" not in summands(forces)
    if not pushed or not pushed_where_they_are(alone, identified.model):
        return expression, identified
    forces = f"{forces}+spring"
    return f"{forces}@{evidence}", learn(named_model(recording.model, summands(forces)), recording, given)[0]


def usual_forces(model: Model) -> str:
    """What is learned where no force is named: in flight air, at a tool that slides its friction, else of joints."""
    jointed = bool(model.robot.single_joint_names)
    if thruster_columns(model):
        return "gp:joint-friction+gp:aerodynamic" if jointed else "gp:aerodynamic"
    if any(slides(contact) for contact in model.contacts):
        return "gp:tool-friction"
    return "gp:joint-friction" if jointed else "gp:joint"


def learn(
    model: Model,
    dataset: Dataset,
    evidence: Sequence[Evidence] = (),
    *,
    points: int | None = None,
    recording: Dataset | None = None,
    baseline: Dataset | None = None,
    engine: Any = "auto",
    iterations: int | None = None,
    **search: Any,
) -> tuple[Posterior, list[str]]:
    """`fit` with the number of rows and the noise that a model needs, and notes on what was decided.

    Functions of one or two inputs learn from all rows, which count for less where their errors resemble each other;
    others from `points`, `POINTS` where that is None. Motions among the evidence are those of `recording`, which may
    have more rows, and intervals of motions are calibrated then. `search` is restarts, seed, jobs.
    """
    motions, usual = [each for each in evidence if isinstance(each, Motions)], usual_evidence(model, dataset)
    sensors = [each for each in evidence or usual if isinstance(each, Sensor)]
    others = [each for each in evidence if each not in (*motions, *sensors)] or [usual[0]]
    first, notes = others[0], []
    others += sensors
    if sensors:
        notes.append(f"evidence: {first}, and {listed([str(each) for each in sensors])}")
    if motions:
        Motions.refuse(model.unknown_forces)
    if not model.unknown_forces and (isinstance(first, Torques) or model.is_open):
        posterior = fit(model, dataset, others, baseline=baseline)
    else:
        dataset = decided(dataset)
        few = bool(model.unknown_forces) and has_few_inputs(model.unknown, model.robot)
        everything = few and points is None and engine in ("auto", "inducing")
        count = len(dataset)
        points = count if everything else min(POINTS if points is None else points, count)
        options = default_options(points)
        options = options if iterations is None else replace(options, iterations=iterations)
        how: dict[str, Any] = {"engine": engine}
        if everything:
            model = with_force_noise(model, dataset)
            how |= all_rows_at_once(points, model.robot.nv)
        if not model.unknown_forces:
            search = {**search, "restarts": 1}  # its starts are all the same
        how |= {"options": options, **search}
        posterior = fit(model, dataset, others, baseline=baseline, points=points, **how)
        if everything:
            posterior, note = allowing_for_correlation(posterior, dataset)
            notes += [] if note is None else [note]
    if motions:
        recording = dataset if recording is None else recording
        posterior = fit(posterior.model, recording, motions, start=posterior)
        posterior, note = with_intervals_of_motions(posterior, recording)
        notes += [] if note is None else [note]
    return posterior, notes


def with_intervals_of_motions(posterior: Posterior, recording: Dataset) -> tuple[Posterior, str | None]:
    """`calibrated`, and up to when; the posterior itself, and why, where the recording is too short for it."""
    try:
        found = calibrated(posterior, recording)
    except InvalidInput as error:
        return posterior, f"intervals of motions are not calibrated: {error}"
    last = found.motion_intervals.horizons[-1] if found.motion_intervals else HORIZONS[-1]
    return found, None if last == HORIZONS[-1] else f"intervals of motions are measured up to {last:g} s"


EQUATIONS = 1_400
"""Of the rows that a search learns from at once, at most: 200 rows of an arm. Its time grows with their cube: twice as
many took four times as long on two arms, and changed errors by less than 1 %."""


def all_rows_at_once(count: int, nv: int) -> dict[str, Any]:
    """Arguments for the `fit` of functions of few inputs to so many rows of nv equations: exact up to a few hundred.

    Beyond, inducing points leave out no more than what ten numbers add to the variance of a row, 10 / count: with a
    tenth of that an arm's errors and intervals were the same within .5 %, for a third more time.
    """
    most = min(MOST_POINTS_FOR_RESTARTS, EQUATIONS // nv)
    return {} if count <= most else {"engine": Inducing(tolerance=10.0 / count), "learning_points": most}


def with_force_noise(model: Model, dataset: Dataset) -> Model:
    """The model with a learned noise of the joint forces beside that of accelerations, where it may learn its noise.

    Forces that are wrong by the same are accelerations that are wrong by more where the inertia is small: taken for
    noise of the acceleration, all rows of a two-joint arm made friction worse than none.
    """
    noise = model.noise
    if noise is None or not noise.learn or noise.force is not None or model.robot.nv == 1:
        return model
    some = with_memory(dataset, model).rows(slice(None, None, max(1, len(dataset) // RESIDUALS_OF_FORCES)))
    q, v, u, a = (torch.tensor(x, device=model.robot.device) for x in (some.q, some.v, some.u, some.a))
    dynamics = model.dynamics(q, v, u)
    residual = (a - dynamics.acceleration_map().offset)[..., None]
    forces = (torch.linalg.pinv(dynamics.H, rtol=1e-8) @ residual)[..., 0].std(0)
    if not float(forces.min()) > 0.0:
        return model
    return replace(model, noise=replace(noise, force=tuple(forces.tolist())))


def allowing_for_correlation(posterior: Posterior, dataset: Dataset) -> tuple[Posterior, str | None]:
    """The posterior from all rows of a log, each of which counts as 1/k, and a note; None where errors are independent.

    Errors of filtered logs resemble each other over k rows, their integrated correlation time
    (`evidence.least_squares.correlation_time`). No row is left out, for friction changes within a few at a reversal.
    """
    k, some = 1.0, with_memory(dataset, posterior.model).rows(slice(RESIDUALS))
    if dataset.time_ordered:
        residual = posterior.predict(some.q, some.v, some.u, covariance=False).mean.cpu().numpy() - some.a
        spread = residual.std(axis=0)
        k = float(np.median(correlation_time(residual / np.where(spread > 0.0, spread, 1.0), some.episode)))
    k = k if k >= NOTICEABLE else 1.0
    if k > 1.0:
        settings = {**posterior.settings, "correlated_rows": k}
        given = posterior.training, posterior.hyperparameters, posterior.result, settings, posterior.engine
        posterior = posterior.conditioned(posterior.trained, *given, posterior.estimates, posterior.latent)
    return posterior, f"errors resemble each other over {k:.0f} rows, which count as one" if k > 1.0 else None


GIVEN, IDENTIFIED, EVIDENCE = "given", "identified", "@"
USUAL = "bodies+viscous+coulomb+rotor"  # forces that are identified where nothing else is asked for
SUMMARIES: Mapping[Kind, str] = {
    "black box": "one Gaussian process per joint on (q, v, u), without physics",
    "residual": "one Gaussian process per joint on the acceleration ({})",
    "force prior": "Gaussian processes on unknown forces ({})",
    "identified": "identified from ALL training rows, noise from training rows held out",
    "given": "the model as given, noise learned",
}


@dataclass(frozen=True)
class Candidate:
    """One model of a comparison.

    given: forces by name, beside those of the robot as given or identified; a model to fit; or a posterior as it is.
    kind, summary: what it is, for verdicts and for the page.
    identification: the name of the identification that it builds on (`identified_model`); None for none.
    evidence, motions: what it is learned from, and refined on afterwards.
    all_rows: whether it learns from all training rows alone, so that one seed stands for all.
    """

    given: tuple[str, ...] | Model | Posterior
    kind: Kind
    summary: str
    identification: str | None = None
    evidence: tuple[Evidence, ...] = ()
    motions: tuple[Evidence, ...] = ()
    all_rows: bool = False

    def model(self, given: Model, identified: Model | str | None) -> Model:
        """What is to be fitted. Raises FitError where the identification has failed, for the reason `identified`."""
        if isinstance(self.given, Model):
            return self.given
        assert not isinstance(self.given, Posterior), "it is fitted"
        base = replace(given, noise=Noise(None, learn=True))
        if self.identification is not None:
            if not isinstance(identified, Model):
                raise FitError(f"the identification that it rests on failed: {identified}")
            base = identified
        model = named_model(base, self.given or (GIVEN,), base.noise)
        if model.noise is not None and (self.kind == "black box" or (model.unknown_forces and few_inputs(model))):
            # held-out noise contains the misfit that the forces are to learn; so many rows show their own
            model = replace(model, noise=replace(model.noise, learn=True))
        return model

    @property
    def digest(self) -> str:
        """What its result depends on, beside its name and all code of forcegp."""
        if isinstance(self.given, tuple):
            return ""
        parts: list[bytes] = []
        if isinstance(self.given, Posterior):
            training = self.given.training
            numbers = [training.q, training.v, training.u, *self.given.hyperparameters.values()]
            parts = [each.detach().cpu().numpy().tobytes() for each in numbers]
        known = self.given if isinstance(self.given, Model) else self.given.model.known
        return hashlib.sha256(b"".join([known.to_json().encode(), *parts])).hexdigest()


Given = str | Model | Posterior  # what may be scored: a name, a model to fit, and a posterior as it is


def few_inputs(model: Model) -> bool:
    """Whether it has unknown forces of one or two inputs alone, which learn from all rows."""
    return bool(model.unknown_forces) and has_few_inputs(model.unknown, model.robot)


def usual_identification(model: Model) -> str:
    """What `identified` is where nothing else is asked for; a body without joints has no friction in them."""
    forces = USUAL if model.robot.single_joint_names else "bodies"
    return f"{forces}{EVIDENCE}{'accelerations' if model.robot.space.is_vector_space else 'torques:both'}"


def default_models(model: Model) -> tuple[str, ...]:
    """Models that are compared where none is named: without refinements on motions where the base moves."""
    if thruster_columns(model) or not model.robot.single_joint_names:
        return GIVEN, IDENTIFIED, "gp:independent", "gp:joint-accelerations", usual_forces(model)
    moved = f"{EVIDENCE}motions:1" if model.robot.space.is_vector_space else ""
    on_forces = [f"{IDENTIFIED}+gp:{name}" for name in ("joint-accelerations", "joint", "joint-friction")]
    refined = (f"{IDENTIFIED}{moved}",) if moved else ()
    return GIVEN, IDENTIFIED, *refined, "gp:independent", *on_forces


def candidates(given: Mapping[str, Given] | Sequence[str], model: Model, identification: str) -> dict[str, Candidate]:
    """The models of a comparison by name, `identified` always among them."""
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
    if isinstance(given, Posterior):
        summary = f"{given.description}, fitted before to {len(given.training)} rows"
        return Candidate(given, kind_of(given.trained, bool(given.parameters)), summary, all_rows=True)
    if isinstance(given, Model):
        every = few_inputs(given) or (given.is_open and not given.unknown_forces)
        return Candidate(given, kind_of(given), "a model of yours", all_rows=every)
    if not isinstance(given, str):
        raise InvalidInput(f"model {name!r} is a {type(given).__name__}; give a name, a Model or a Posterior.")
    words, motions, others, text = _parts(given)
    forces, on_identified = "+".join(words), words[0] == IDENTIFIED
    words = words[on_identified:]
    try:
        described = named_model(model, words or (GIVEN,))
    except InvalidInput as error:
        known = f"{GIVEN}, {IDENTIFIED} or FORCES[@EVIDENCE]"
        raise InvalidInput(f"no model is called {name!r}; give {known} ({error})") from None
    unknown, key = described.unknown_forces, None
    if described.is_open and not model.is_open and not unknown:  # laws alone: an identification of its own
        if on_identified:
            every = "+".join((identification.partition(EVIDENCE)[0], *words))
            raise InvalidInput(f"model {name!r}: `identified` has its laws already; name all laws, as in {every}.")
        key, words = f"{forces}{EVIDENCE}{text}" if text else forces, ()
    elif on_identified:
        own, _, usual = identification.partition(EVIDENCE)
        key = f"{own}{EVIDENCE}{text if text and not unknown else usual}"
    if motions:
        Motions.refuse(unknown)
    if motions and key is None:
        raise InvalidInput(f"model {name!r} has nothing to refine on motions; add forces.")
    kind = kind_of(described, key is not None) if unknown or key else "given"
    where = f", beside {key}" if key and words else f": {key}" if key else ""
    refined = "; refined on the motions of all training rows" if motions else ""
    summary = f"{SUMMARIES[kind].format(' + '.join(words))}{where}{refined}"
    every = few_inputs(described) or (key is not None and not unknown)
    return Candidate(words, kind, summary, key, others if unknown else (), motions, every)


def kind_of(model: Model, identified: bool = False) -> Kind:
    """Which questions a model answers."""
    if any(isinstance(force, IndependentAccelerations) for force in model.unknown_forces):
        return "black box"
    if any(isinstance(force, JointAccelerations) for force in model.unknown_forces):
        return "residual"
    return "force prior" if model.unknown_forces else "identified" if identified or model.is_open else "given"


def _parts(name: str) -> tuple[tuple[str, ...], tuple[Evidence, ...], tuple[Evidence, ...], str]:
    forces, _, text = name.partition(EVIDENCE)
    words = summands(text) if text else ()
    try:
        evidence = parse_evidence(list(words)) if words else ()
    except InvalidInput as error:
        raise InvalidInput(f"model {name!r}: {error}") from None
    motions = tuple(each for each in evidence if isinstance(each, Motions))
    others = "+".join(word for word, each in zip(words, evidence, strict=True) if each not in motions)
    return summands(forces), motions, tuple(each for each in evidence if each not in motions), others


def checked_identification(name: str, model: Model, rows: Dataset) -> tuple[Model, Accelerations | Torques]:
    """The model that is open where laws and bodies of this name are, and the evidence. Raises InvalidInput."""
    words, _, evidence, _ = _parts(name)
    opened = named_model(model, words)
    if opened.unknown_forces or not opened.is_open:
        raise InvalidInput(f"identification {name!r} has nothing to identify, or unknown forces; name laws and bodies.")
    chosen = (evidence or usual_evidence(opened, rows))[0]
    if not isinstance(chosen, Accelerations | Torques):
        raise InvalidInput(f"identification {name!r} is from {chosen.name}; give accelerations or torques.")
    return opened, chosen


def identified_model(name: str, model: Model, rows: Dataset, before: Posterior | None = None) -> Model:
    """The model that this name makes of these rows, or made `before`, with the noise of rows that are held out."""
    opened, evidence = checked_identification(name, model, rows)
    rows = replace(rows, measured={})  # none of which is among the evidence
    if before is None:
        opened, _ = with_friction_chosen(opened, rows, evidence)  # once, for all parts of the rows
    found: Any = fit(opened, rows, evidence) if before is None else before
    return replace(found.model, noise=held_out_noise(with_choice_of(opened, found), rows, evidence))
