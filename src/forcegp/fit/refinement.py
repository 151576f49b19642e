"""Fitting again: on all rows from what some rows gave, and with the normal force that a fit has found."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from forcegp.data import Dataset, farthest_rows
from forcegp.data.preparation import memory
from forcegp.errors import DataWarning, InvalidInput, NumericalWarning
from forcegp.evidence.likelihood import MarginalLikelihood, TrainingData, check_distance
from forcegp.forces import UnknownForces
from forcegp.forces.contact_friction import JAMMING, TabulatedCurve, refined_loads
from forcegp.inference import Choice, Engine, Exact, Inducing, InducingPosterior, ProblemSize, choose_engine
from forcegp.inference.engines import ENOUGH, MOST_EXACT_ROWS
from forcegp.inference.memory import blas_threads, require_memory
from forcegp.noise import ACCELERATION, SENSOR
from forcegp.posterior import Posterior
from forcegp.robots.arguments import whole_number

FEWEST_INDEPENDENT, TELLING = 10, 100  # rows that noise is learned from, and those that tell it within a tenth
LEARNING_ROWS = 600  # rows that hyper-parameters are found on where there are more than `MOST_EXACT_ROWS`


def learning_rows(rows: Dataset, learning_points: int | None, *, ordered: bool) -> Dataset:
    """The rows that hyper-parameters are found on: all up to 1500, else 600 (or so many) that lie farthest apart.

    `ordered`: the rows come in that order already. Raises InvalidInput for a number out of range.
    """
    count = len(rows)
    if learning_points is None:
        learning_points = count if count <= MOST_EXACT_ROWS else LEARNING_ROWS
    if whole_number("learning_points", learning_points, 0) < 2:
        raise InvalidInput(f"learning_points is {learning_points}; hyper-parameters need at least 2 rows")
    if learning_points >= count:
        return rows
    return rows.rows(slice(learning_points)) if ordered else farthest_rows(rows, learning_points)


def independent_rows(rows: Dataset) -> Dataset:
    """Those that lie further apart in time than a filter makes them alike, for learned noise is taken for independent.

    Warns where few are left, and where so few that all stay.
    """
    seconds = memory(rows.metadata) * (1.0 - 1e-9)
    if seconds == 0.0:
        return rows
    kept, found = [], dict[tuple[int, int], float]()  # at most one time in a stretch of that length
    for row, (time, episode) in enumerate(zip(rows.time.tolist(), rows.episode.tolist(), strict=True)):
        place = int(time // seconds)
        if all(abs(found.get((episode, place + k), np.inf) - time) >= seconds for k in (-1, 0, 1)):
            found[episode, place] = time
            kept.append(row)
    if len(kept) >= min(TELLING, len(rows)):
        return rows.rows(np.array(kept))
    few = len(kept) < FEWEST_INDEPENDENT
    what = "too few, so all are taken, and learned noise may be none" if few else "and noise is learned from these"
    warnings.warn(
        f"a filter repeats in each row those up to {seconds:.2g} s away: {len(kept)} of {len(rows)} rows are "
        f"independent, {what}; give a longer log, or `noise` if it is known",
        DataWarning,
        stacklevel=4,
    )
    return rows if few else rows.rows(np.array(kept))


def require_memory_to_learn(likelihood: MarginalLikelihood) -> None:
    """Raise NotEnoughMemory where the exact likelihood of these rows does not fit into memory."""
    with torch.no_grad():
        one = torch.zeros_like(likelihood.training.a[0])
        size = ProblemSize.of(likelihood.terms({ACCELERATION: one, SENSOR: one[:1]}))
    remedy = "find hyper-parameters on fewer rows: `learning_points=600`, or give fewer points"
    what = f"the likelihood of N={size.rows} rows with its gradients"
    needed = Exact().required_bytes(size) + 24 * size.latents * size.rows**2  # gradients of the kernel matrices as well
    require_memory(needed, what, remedy, likelihood.training.q.device)


def on_all_rows(fitted: Posterior, rows: Dataset, engine: Engine | None, described: Mapping[str, Any]) -> Posterior:
    """`fitted`, conditioned on all `rows` by the engine, or by one that is chosen for their number where it is None.

    `described` replaces what the settings hold of the rows. Raises NotEnoughMemory, NumericalError.
    """
    reference = training = fitted.training
    likelihood, latent = fitted.likelihood, fitted.latent
    if len(rows) != len(reference.q):
        training = replace(TrainingData.of(rows, reference.q.device, reference.sensed), reference=reference)
        likelihood = replace(likelihood, training=training)
        fitted.trained.check_states(training.q, training.v, training.u)
        check_distance(fitted.trained, training)
    with torch.no_grad():
        size = ProblemSize.of(likelihood.terms(fitted.hyperparameters))
    if engine is None or not size.latents:
        choice = choose_engine(size, training.q.device)
    else:
        choice = Choice(engine, f"{engine.name}: as asked for")
    with blas_threads(training.q.numel()):
        if training is not reference or not isinstance(choice.engine, Exact):
            latent = likelihood.condition(fitted.kernels, fitted.hyperparameters, choice.engine)
        left_out = latent.left_out if isinstance(latent, InducingPosterior) else 0.0
        if engine is None and isinstance(choice.engine, Inducing) and left_out > ENOUGH:
            choice = choose_engine(size, training.q.device, inducing=False)
            short = f"fewer inducing points leave out {left_out:.2g} of the noise variance of a row"
            choice = Choice(choice.engine, f"{choice.reason}; {short}")
            latent = likelihood.condition(fitted.kernels, fitted.hyperparameters, choice.engine)
        settings = {**fitted.settings, **described, "learning_points": len(reference.q)}
        settings |= {"engine": choice.engine.to_dict(), "engine_reason": choice.reason}
        posterior = replace(fitted, likelihood=likelihood, settings=settings, latent=latent, engine=choice.engine)
    asked = max(ENOUGH, engine.tolerance if isinstance(engine, Inducing) else 0.0)
    if isinstance(latent, InducingPosterior) and latent.left_out > asked:
        warnings.warn(
            f"{sum(map(len, latent.features))} inducing points leave out {latent.left_out:.2g} of the noise variance "
            "of a row, so that the posterior is an approximation with wider intervals than the exact one; give more "
            "points, or take `engine='exact'`",
            NumericalWarning,
            stacklevel=4,
        )
    return posterior


ROUNDS = 8  # most fits after the first; measured with dry friction that falls with speed, 3 to 5 are enough
SETTLED = 1e-3
"""Relative change of the mixing vectors (root mean square over training rows) below which the loads have settled."""
NOTICEABLE = 2.0  # nats that rounds differ by without telling anything
PLACES = 60  # velocities at which a curve is tabulated, of those that the data visited
BEYOND = (1.2, 1.5, 2.0, 3.0, 5.0)
"""Multiples of the largest and smallest visited velocity at which it is tabulated as well: continued from the last two
of `PLACES`, whose difference is noise, it would soon be far from the curve itself.
"""


def fit_with_refined_loads(
    first: Posterior, again: Callable[[UnknownForces, Posterior], Posterior], rounds: int = ROUNDS
) -> Posterior:
    """`first`, or the last of the fits that follow it under the normal forces of the one before, or the most likely.

    Every round is an exact fit of a prior: friction in proportion to a given function of the state. `again(prior,
    posterior)` fits with another one, from the parameters of a posterior. Warns (NumericalWarning) where the normal
    forces have not settled after `rounds` fits, and where friction as the last one expects it nearly jams a contact.
    """
    given = first.trained.unknown  # whose terms hold the expectations of the user
    best = last = first
    with warnings.catch_warnings():  # what an early round expects may jam without meaning anything
        warnings.filterwarnings("ignore", JAMMING, NumericalWarning)
        for fits in range(rounds + 1):
            prior = refined_loads(given, last.trained.robot, lambda name, p=last: _table(p, name))
            if prior is None:
                return first
            with torch.no_grad():  # of mixing vectors at the training points
                old, new = (x.direction(last.likelihood.dynamics) for x in (last.trained.unknown, prior))
            change = float((new - old).square().mean().sqrt() / old.square().mean().sqrt())
            if change < SETTLED:
                # the last is consistent with its own curves; an earlier one must be clearly likelier to be kept
                if last.negative_log_likelihood < best.negative_log_likelihood + NOTICEABLE:
                    best = last
                break
            if fits == rounds:
                warnings.warn(
                    f"the normal forces of load-dependent friction would still change by {change:.1%} after {rounds} "
                    "refinements; the most likely fit is kept. Give expected=COEFFICIENT to hold them fixed.",
                    NumericalWarning,
                    stacklevel=3,
                )
                break
            last = again(prior, last).with_settings(load_refinements=fits + 1)
            if last.negative_log_likelihood < best.negative_log_likelihood:
                best = last
    if best is not first:
        with torch.no_grad():
            best.trained.unknown.direction(best.likelihood.dynamics)  # warns where the friction that was found jams
    return best


def _table(posterior: Posterior, latent: str) -> TabulatedCurve:
    """The posterior mean of a friction curve over the velocities that the data visited, 0 included, and beyond."""
    visited = posterior.curve(latent, points=2).visited[:, 0]
    low, high = float(visited[0].clamp_max(0.0)), float(visited[1].clamp_min(0.0))
    high = max(high, low + 1e-6)
    at = torch.linspace(low, high, PLACES, dtype=torch.float64)
    below, above = ([end * factor for factor in BEYOND] if end else [] for end in (low, high))
    places = [*reversed(below), *at.tolist(), *above]
    mean = posterior.curve(latent, torch.tensor(places, dtype=torch.float64)).mean
    return TabulatedCurve(tuple(places), tuple(mean.tolist()))
