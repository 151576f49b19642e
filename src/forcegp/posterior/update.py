"""A fitted model that learns from more rows: exact conditioning at the parameters that it has, in bounded memory."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp.data import Dataset
from forcegp.errors import InvalidInput, require_known
from forcegp.evidence.likelihood import MarginalLikelihood
from forcegp.evidence.training_data import TrainingData, check_distance
from forcegp.forces import UnknownForces
from forcegp.inference import ExactPosterior, InducingPosterior, Terms, exact
from forcegp.inference.cholesky_update import rows_to_keep, with_only, with_rows
from forcegp.inference.engines import ENOUGH, InducingWeights
from forcegp.inference.memory import blas_threads, require_memory
from forcegp.robots import Robot
from forcegp.robots.arguments import whole_number

Structured = Any
"""A `Posterior`, whose module imports this one."""

SHARE_AT_ONCE = 4
"""With a budget, rows are taken in by budget / SHARE_AT_ONCE at a time, which bounds the memory of many rows."""


def learn_more_rows(
    posterior: Structured,
    rows: Dataset,
    budget: int | None,
    keep: Callable[[ExactPosterior, int], Tensor] = rows_to_keep,
) -> Structured:
    """What `Posterior.update` documents without a horizon; `keep` gives the numbers of the rows that stay."""
    latent, training = exact(posterior.latent, "learning from more rows"), posterior.training
    budget = None if budget is None else whole_number("budget", budget, 2)
    height = len(rows) if budget is None else max(1, budget // SHARE_AT_ONCE)
    _require_memory(latent, len(rows), height, budget)
    more = _on_rows(posterior, rows)
    added, reference = more.training, more.training.reference
    with torch.no_grad(), blas_threads(training.q.numel()):
        features, W, residual, variance = more.terms(posterior.hyperparameters)
        variance = variance.expand(len(W), *variance.shape[1:])
        for start in range(0, len(W), height):
            part = slice(start, start + height)
            latent = with_rows(latent, Terms([z[part] for z in features], W[part], residual[part], variance[part]))
            training = _joined(training, _selected(added, part))
            if budget is not None and len(training.q) > budget:
                kept = keep(latent, budget)
                latent, training = with_only(latent, kept), _selected(training, kept)
    likelihood = replace(more, training=replace(training, reference=reference))
    changes = {"points": len(latent.system.alpha), "budget": budget}
    changes["rows_added"] = posterior.settings.get("rows_added", 0) + len(rows)
    return replace(posterior, likelihood=likelihood, latent=latent).with_settings(**changes)


def learn_and_forget(
    posterior: Structured, rows: Dataset, budget: int | None, horizon: float | Mapping[str, float]
) -> Structured:
    """What it documents with one. An exact posterior goes over to inducing points among its rows."""
    settings, until, latent = posterior.settings, float(rows.time.max()), posterior.latent
    seconds = until - settings.get("learned_until", float(rows.time.min()))
    if budget is not None or seconds < 0.0:
        raise InvalidInput(
            f"budget is {budget} and these rows end {seconds:.4g} s after those learned before; with a horizon give no "
            "budget, and rows in the order of time."
        )
    kept = _parts_kept(horizon, seconds, posterior.trained.unknown, posterior.model.robot)
    more = _on_rows(posterior, rows)
    with torch.no_grad(), blas_threads(len(rows)):
        if not isinstance(latent, InducingPosterior):
            kernels, terms = exact(latent, "learning from more rows").kernels, posterior.likelihood.terms
            latent = InducingPosterior.condition(
                kernels, terms(posterior.hyperparameters), points=100, tolerance=ENOUGH
            )
        latent = replace(latent, space=latent.space.learned(kept, more.terms(posterior.hyperparameters)))
    engine = InducingWeights(tuple(len(z) for z in latent.features))
    changes = {"engine": engine.to_dict(), "learned_until": until}
    changes["rows_added"] = settings.get("rows_added", 0) + len(rows)
    return replace(posterior, latent=latent, engine=engine).with_settings(**changes)


def _parts_kept(
    horizon: float | Mapping[str, float], seconds: float, prior: UnknownForces, robot: Robot
) -> list[float]:
    """exp(-seconds / horizon) of every latent, from one horizon in s or {term: its own}. Raises InvalidInput."""
    terms = prior.named(robot)
    horizons = horizon if isinstance(horizon, Mapping) else {name: horizon for name, *_ in terms}
    for name, given in horizons.items():
        require_known("term", name, "this model", [name for name, *_ in terms])
        if not isinstance(given, int | float) or not given > 0.0:
            raise InvalidInput(f"horizon is {given!r}; give seconds above 0, math.inf where nothing is forgotten.")
    found = [[horizons.get(name, math.inf)] * len(term.latent_names(robot)) for name, term, _ in terms]
    return [math.exp(-seconds / own) for part in found for own in part]


def _on_rows(posterior: Structured, rows: Dataset) -> MarginalLikelihood:
    """The likelihood of other rows, checked, with the standardization at hand instead of one that is computed again."""
    likelihood, stated = posterior.likelihood, rows.noise_std
    training = likelihood.training
    reference = training if training.reference is None else training.reference
    if reference.noise_std is not None and stated is not None and stated.ndim == 1:
        rows = replace(rows, noise_std=np.tile(stated, (len(rows), 1)))  # every row states it then
    alike = training.correlated_rows
    added = replace(TrainingData.of(rows, training.q.device), reference=reference, correlated_rows=alike)
    likelihood.model.check_states(added.q, added.v, added.u)
    check_distance(likelihood.model, added)
    return replace(likelihood, training=added, fixed_standardization=likelihood.standardization)


def _require_memory(latent: ExactPosterior, added: int, height: int, budget: int | None) -> None:
    """Raise NotEnoughMemory where `added` rows, `height` at a time, do not fit: before anything is computed."""
    count, rank, latents = latent.system.deflation.C.shape
    height = min(height, added)
    before = count if budget is None else min(max(count, budget), count + added - height)  # at the largest step
    size, new = rank * (before + height), rank * height
    needed = 8 * (size**2 + 2 * new * size + latents * height**2)  # the new factor, blocks of new rows and their copies
    what, remedy = f"a posterior of {count} + {added} rows", "give a budget of rows to keep (budget=N), or fewer rows"
    if budget is not None:
        needed = max(needed, 8 * 4 * size**2)  # the factor, its inverse, and two matrices that join halves of it
        what, remedy = f"learning from {added} rows with budget={budget}", "give a smaller budget"
        if count > budget:
            remedy += f", or a posterior of fewer rows (it has {count})"
    require_memory(needed, what, remedy, latent.system.alpha.device)


def _selected(training: TrainingData, index: Tensor | slice) -> TrainingData:
    return replace(training, **{name: rows[index] for name, rows in _rows_of(training)})


def _joined(first: TrainingData, second: TrainingData) -> TrainingData:
    return replace(first, **{name: torch.cat([rows, getattr(second, name)]) for name, rows in _rows_of(first)})


def _rows_of(training: TrainingData) -> list[tuple[str, Tensor]]:
    """What is known of every row, by name."""
    named = [(name, getattr(training, name)) for name in ("q", "v", "u", "a", "noise_std")]
    return [(name, rows) for name, rows in named if rows is not None]
