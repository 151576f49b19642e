"""Learning from many rows: hyper-parameters from some of them, the posterior from all of them by an engine.

`StructuredGP.fit` takes `learning_rows` (all, or those farthest apart) to the search; `on_all_rows` then lets the
engine condition on all rows at the same hyper-parameters, with features prepared as for the rows that gave them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from forcegp.data import Dataset, farthest_rows
from forcegp.errors import InvalidInput
from forcegp.inference import (
    Choice,
    Engine,
    Exact,
    Inducing,
    InducingPosterior,
    LatentPosterior,
    ProblemSize,
    choose_engine,
)
from forcegp.inference.engines import MOST_EXACT_ROWS, MOST_ITERATIVE_ROWS
from forcegp.inference.iterative import Iteration
from forcegp.inference.linear_functionals import require_memory_for_functionals
from forcegp.inference.memory import require_memory
from forcegp.models.noise import ACCELERATION
from forcegp.models.search import blas_threads
from forcegp.models.structured.marginal_likelihood import MarginalLikelihood
from forcegp.models.structured.posterior import StructuredPosterior
from forcegp.models.structured.prior_checks import check_distance
from forcegp.models.structured.refinement import refined
from forcegp.models.training_data import TrainingData
from forcegp.robots.arguments import whole_number

LEARNING_ROWS = 600
"""Rows that hyper-parameters are found on where there are more than `MOST_EXACT_ROWS`."""


def learning_rows(rows: Dataset, learning_points: int | None, *, ordered: bool) -> Dataset:
    """The rows that hyper-parameters are found on: all, or those that lie farthest apart.

    `ordered`: the rows come in that order already. None means all rows up to 1500, and 600 beyond.
    Raises InvalidInput for a number out of range.
    """
    count = len(rows)
    if learning_points is None:
        learning_points = count if count <= MOST_EXACT_ROWS else LEARNING_ROWS
    if whole_number("learning_points", learning_points, 0) < 2:
        raise InvalidInput(f"learning_points is {learning_points}; hyper-parameters need at least 2 rows")
    if learning_points >= count:
        return rows
    return rows.rows(slice(learning_points)) if ordered else farthest_rows(rows, learning_points)


def require_memory_to_learn(likelihood: MarginalLikelihood) -> None:
    """Raise NotEnoughMemory where the exact likelihood of these rows or windows does not fit into memory."""
    weights = likelihood.training.weights
    if weights is not None:
        robot = likelihood.system.robot
        require_memory_for_functionals(weights, robot.nv, len(likelihood.prior.latent_names(robot)))
        return
    with torch.no_grad():
        size = ProblemSize.of(likelihood.terms({ACCELERATION: torch.zeros_like(likelihood.training.a[0])}))
    remedy = "find hyper-parameters on fewer rows: `learning_points=600`, or give fewer points"
    what = f"the likelihood of N={size.rows} rows with its gradients"
    require_memory(Exact().bytes_to_learn(size), what, remedy, likelihood.training.q.device)


def on_all_rows(
    fitted: StructuredPosterior,
    rows: Dataset,
    engine: Engine | None,
    described: Mapping[str, Any],
    hyperprior: bool,
    report: Iteration | None = None,
) -> StructuredPosterior:
    """`fitted`, conditioned on all `rows` by the engine, or by one that is chosen for their number where it is None.

    `described` replaces what the settings hold of the rows. Raises NotEnoughMemory, NumericalError.
    """
    reference = fitted.training
    training = reference if len(rows) == len(reference.q) else _training(rows, reference)
    likelihood = replace(fitted.likelihood, training=training)
    fitted.model.system.check_states(training.q, training.v, training.u)
    if training is not reference:
        check_distance(fitted.model.system, training)
    with torch.no_grad():
        size = ProblemSize.of(likelihood.terms(fitted.parameters))
    if engine is None or not size.latents:
        choice = choose_engine(size, training.q.device)
    else:
        choice = Choice(engine, f"{engine.name}: as asked for")
    settings = {**fitted.settings, **described, "learning_points": len(reference.q)}
    if isinstance(choice.engine, Exact) and training is reference:
        settings |= {"engine": choice.engine.to_dict(), "engine_reason": choice.reason}
        return replace(fitted, settings=settings)
    with blas_threads(training.q.numel()):
        latent = likelihood.condition(fitted.kernels, fitted.parameters, choice.engine, report=report)
        if engine is None and _leaves_too_much_out(latent, choice.engine):
            choice, latent = _another(choice, latent, size, fitted, likelihood, report)
        settings |= {"engine": choice.engine.to_dict(), "engine_reason": choice.reason}
        posterior = replace(fitted, likelihood=likelihood, settings=settings, latent=latent, engine=choice.engine)
        return refined(posterior, hyperprior, report)


def _training(rows: Dataset, reference: TrainingData) -> TrainingData:
    return replace(TrainingData.of(rows, reference.q.device), reference=reference)


def _leaves_too_much_out(latent: LatentPosterior, engine: Engine) -> bool:
    return isinstance(latent, InducingPosterior) and isinstance(engine, Inducing) and latent.left_out > engine.tolerance


def _another(
    choice: Choice,
    latent: LatentPosterior,
    size: ProblemSize,
    fitted: StructuredPosterior,
    likelihood: MarginalLikelihood,
    report: Iteration | None,
) -> tuple[Choice, LatentPosterior]:
    """An engine without inducing points, where these leave too much out and there are not too many rows for it."""
    assert isinstance(latent, InducingPosterior)
    short = f"inducing points leave out {latent.left_out:.2g} of the noise variance of a row"
    if size.rows > MOST_ITERATIVE_ROWS:
        return Choice(choice.engine, f"{choice.reason}; {short}"), latent
    other = choose_engine(size, likelihood.training.q.device, inducing=False)
    other = Choice(other.engine, f"{other.reason}; {short}")
    return other, likelihood.condition(fitted.kernels, fitted.parameters, other.engine, report=report)
