"""What commands and comparisons do with a log: models by name, and one way to learn."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from forcegp.data import Dataset, thruster_columns
from forcegp.errors import InvalidInput
from forcegp.evidence import Accelerations, Evidence, Motions, Torques
from forcegp.evidence.least_squares import ROUNDS, correlation_time
from forcegp.evidence.recorded_rows import slides
from forcegp.fit import ALL_ROWS, calibrated, default_options, default_restarts, fit
from forcegp.fit.refinement import refined
from forcegp.fit.search import MOST_POINTS_FOR_RESTARTS
from forcegp.forces import (
    IndependentAccelerations,
    has_few_inputs,
    parse_forces,
    split_outside,
)
from forcegp.inference import Inducing
from forcegp.model import Model
from forcegp.noise import Noise
from forcegp.posterior import Posterior

Report = Callable[[int, int, str], None]
"""Called as report(done, total, what happens)."""

GIVEN, ONLY, NONE = "given", "only", "none"
"""First words of the forces of a model: those that it has, and none of them; "none" adds nothing."""

POINTS = 200
"""Rows that functions of many inputs are learned from where nobody says how many."""
RESIDUALS = 20_000  # rows whose residuals show how long errors resemble each other
NOTICEABLE = 1.5  # rows over which they must to count for less
RESIDUALS_OF_FORCES = 1000  # rows that show where the noise of forces begins
STEPS = 100  # of a search on motions, for the bar alone


def summands(expression: str) -> tuple[str, ...]:
    """The words between the "+" of an expression that stand outside of parentheses."""
    return tuple(part.strip() for part in split_outside(expression, "+"))


def named_model(model: Model, words: Sequence[str], noise: Noise | None = None) -> Model:
    """The model with forces as commands name them: viscous, gp:joint-friction, payload:tool0.

    They come beside those that it has, and laws in the place of laws of their class. A first word "only" leaves out
    what it has, so that the list is complete and unknown forces without rigid-bodies carry gravity and actuation, too;
    "given" and "none" add nothing. "gp:independent" stands alone, without physics. Raises InvalidInput.
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


def usual_forces(model: Model) -> str:
    """What is learned where no force is named: in flight air, at a tool that slides its friction, else of the joints.

    Under feet that stand nothing slides, so no friction acts there. A body without joints has forces of any kind.
    """
    jointed = bool(model.robot.single_joint_names)
    if thruster_columns(model):
        return "gp:joint-friction+gp:aerodynamic" if jointed else "gp:aerodynamic"
    if any(slides(contact) for contact in model.touching):
        return "gp:tool-friction"
    return "gp:joint-friction" if jointed else "gp:joint"


def usual_evidence(model: Model) -> Evidence:
    """That of `fit` where none is named."""
    if model.unknown_forces or not model.is_open:
        return Accelerations()
    return Torques() if model.robot.space.is_vector_space else Torques(noisy="both")


def learn(
    model: Model,
    dataset: Dataset,
    evidence: Sequence[Evidence] = (),
    *,
    points: int | None = None,
    recording: Dataset | None = None,
    baseline: Dataset | None = None,
    engine: Any = "auto",
    learning_points: int | None = None,
    iterations: int | None = None,
    report: Report | None = None,
    **search: Any,
) -> tuple[Posterior, list[str]]:
    """`fit` with the number of rows and the noise that a model needs, and notes on what was decided.

    Functions of one or two inputs learn from all rows, which count for less where their errors resemble each other;
    others from `points`, `POINTS` where that is None. Motions among the evidence are those of `recording`, which may
    have more rows, and intervals of motions are calibrated then. `search` is restarts, seed, jobs.
    """
    motions = [each for each in evidence if isinstance(each, Motions)]
    others = [each for each in evidence if not isinstance(each, Motions)] or [usual_evidence(model)]
    first, notes = others[0], []
    if motions and any(isinstance(force, IndependentAccelerations) for force in model.unknown_forces):
        raise InvalidInput("motions refine physics, and gp:independent has none; leave them out.")
    if not model.unknown_forces and (isinstance(first, Torques) or model.is_open):
        posterior = fit(model, dataset, others, baseline=baseline, progress=_progress(report, 1, ROUNDS))
    else:
        few = bool(model.unknown_forces) and has_few_inputs(model.unknown, model.robot)
        everything = few and points is None and engine in ("auto", "inducing")
        count = len(dataset)
        points = count if everything else min(POINTS if points is None else points, count)
        options = default_options(points)
        options = options if iterations is None else replace(options, iterations=iterations)
        how: dict[str, Any] = {"engine": engine, "learning_points": learning_points}
        if everything:
            model = with_force_noise(model, dataset)
            how |= all_rows_at_once(points, model.robot.nv)
            how |= {} if learning_points is None else {"learning_points": learning_points}
        if not model.unknown_forces:
            search = {**search, "restarts": 1}  # its starts are all the same
        restarts = search.get("restarts") or default_restarts(points)
        how |= {"options": options, **search}
        progress = _progress(report, restarts, options.iterations)
        posterior = fit(model, dataset, others, baseline=baseline, points=points, progress=progress, **how)
        if everything:
            posterior, note = allowing_for_correlation(posterior, dataset)
            notes += [] if note is None else [note]
    if motions:
        recording = dataset if recording is None else recording
        posterior = fit(posterior.model, recording, motions, start=posterior, progress=_progress(report, 1, STEPS))
        posterior, note = with_intervals_of_motions(posterior, recording)
        notes += [] if note is None else [note]
    return posterior, notes


def _progress(report: Report | None, restarts: int, steps: int) -> Any:
    """What `fit` calls, in terms of steps done and in all."""
    if report is None:
        return None

    def progress(restart: int, iteration: int, value: float) -> None:
        size = f"{value:.1f}" if abs(value) >= 10.0 else f"{value:.3g}"
        if restart == ALL_ROWS:
            report(min(iteration, steps), steps, f"all rows, step {iteration}: {size}")
            return
        start = f"start {restart + 1} of {restarts}, " if restarts > 1 else ""
        done = restart * steps + min(iteration, steps)
        report(done, restarts * steps, f"{start}iteration {iteration}, objective {size}")

    return progress


def with_intervals_of_motions(
    posterior: Posterior, recording: Dataset, report: Callable[[int, int], None] | None = None
) -> tuple[Posterior, str | None]:
    """`calibrated`; the posterior itself, and why, where the recording is too short for it."""
    try:
        return calibrated(posterior, recording, report=report), None
    except InvalidInput as error:
        return posterior, f"intervals of motions are not calibrated: {error}"


EQUATIONS = 2_800
"""Of the rows that a search learns from at once, at most: 400 rows of an arm. Its time grows with their cube."""


def all_rows_at_once(count: int, nv: int) -> dict[str, Any]:
    """Arguments for the `fit` of functions of few inputs to so many rows of nv equations: exact up to a few hundred.

    Beyond, by inducing points that leave out less than what one number adds to the variance of a row, 1 / count: what
    all rows leave open of a function is small, and intervals of curves hold what is left out, too. Hyper-parameters are
    improved on all rows afterwards (`allowing_for_correlation`).
    """
    most = min(MOST_POINTS_FOR_RESTARTS, EQUATIONS // nv)
    return {} if count <= most else {"engine": Inducing(tolerance=1.0 / count, refine=0), "learning_points": most}


def with_force_noise(model: Model, dataset: Dataset) -> Model:
    """The model with a learned noise of the joint forces beside that of accelerations, where it may learn its noise.

    Forces that are wrong by the same everywhere are accelerations that are wrong by more where the inertia is small:
    taken for noise of the acceleration, all rows of a two-joint arm made friction worse than none. It begins at the
    scatter of the forces that the known physics lacks.
    """
    noise = model.noise
    if noise is None or not noise.learn or noise.force is not None or model.robot.nv == 1:
        return model
    some = dataset.rows(slice(None, None, max(1, len(dataset) // RESIDUALS_OF_FORCES)))
    q, v, u, a = (torch.tensor(x, device=model.robot.device) for x in (some.q, some.v, some.u, some.a))
    dynamics = model.dynamics(q, v, u)
    residual = (a - dynamics.acceleration_map().offset)[..., None]
    forces = (torch.linalg.pinv(dynamics.H, rtol=1e-8) @ residual)[..., 0].std(0)
    if not float(forces.min()) > 0.0:
        return model
    return replace(model, noise=replace(noise, force=tuple(forces.tolist())))


def allowing_for_correlation(posterior: Posterior, dataset: Dataset) -> tuple[Posterior, str | None]:
    """The posterior from all rows of a log, learned from them as the independent rows that they are worth; and a note.

    Errors of filtered and resampled logs resemble each other from row to row; taken for independent, 20,000 rows would
    count as 20,000 facts. With the integrated correlation time k of the residuals, in rows, every row counts as 1/k
    (`evidence.least_squares.correlation_time`, `TrainingData`), for the functions and for hyper-parameters, which
    inducing points then improve on all rows. No row is left out, for friction changes within a few of them at a
    reversal. The note is None where errors do not resemble each other.
    """
    k, some = 1.0, dataset.rows(slice(RESIDUALS))
    if dataset.time_ordered:
        residual = posterior.predict(some.q, some.v, some.u, covariance=False).mean.cpu().numpy() - some.a
        spread = residual.std(axis=0)
        k = float(np.median(correlation_time(residual / np.where(spread > 0.0, spread, 1.0), some.episode)))
    k = k if k >= NOTICEABLE else 1.0
    if k > 1.0:
        settings = {**posterior.settings, "correlated_rows": k}
        given = posterior.training, posterior.hyperparameters, posterior.result, settings, posterior.engine
        posterior = posterior.conditioned(posterior.trained, *given, estimates=posterior.estimates)
    if isinstance(posterior.engine, Inducing):
        posterior = refined(replace(posterior, engine=replace(posterior.engine, refine=Inducing.refine)))
    return posterior, f"errors resemble each other over {k:.0f} rows, which count as one" if k > 1.0 else None
