"""A fitted model that learns from more rows: exact conditioning at the parameters that it has, in bounded memory."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from forcegp.data import Dataset
from forcegp.errors import InvalidInput, require_known
from forcegp.evidence.likelihood import MarginalLikelihood, TrainingData, check_distance
from forcegp.forces import UnknownForces
from forcegp.inference import ExactPosterior, InducingPosterior, exact
from forcegp.inference.engines import ENOUGH, InducingWeights
from forcegp.inference.memory import blas_threads, require_memory
from forcegp.inference.posterior import with_rows
from forcegp.robots import Robot

Structured = Any
"""A `Posterior`, whose module imports this one."""


def learn_more_rows(posterior: Structured, rows: Dataset) -> Structured:
    """What `Posterior.update` documents without a horizon."""
    latent, training = exact(posterior.latent, "learning from more rows"), posterior.training
    _require_memory(latent, len(rows))
    more = _on_rows(posterior, rows)
    with torch.no_grad(), blas_threads(training.q.numel()):
        terms = more.terms(posterior.hyperparameters)
        variance = terms.noise.expand(len(terms.W), *terms.noise.shape[1:])
        latent = with_rows(latent, terms._replace(noise=variance))
    both = training, more.training
    sensed = {frame: torch.cat([x.sensed[frame] for x in both]) for frame in training.sensed}
    pairs = {name: [getattr(x, name) for x in both] for name in (*"qvua", "strokes")}
    joined = {name: None if any(x is None for x in pair) else torch.cat(pair) for name, pair in pairs.items()}
    likelihood = replace(more, training=replace(training, **joined, sensed=sensed, reference=more.training.reference))
    changes = {"points": len(latent.system.alpha), "rows_added": posterior.settings.get("rows_added", 0) + len(rows)}
    return replace(posterior, likelihood=likelihood, latent=latent).with_settings(**changes)


def learn_and_forget(posterior: Structured, rows: Dataset, horizon: float | Mapping[str, float]) -> Structured:
    """What it documents with one. An exact posterior goes over to inducing points among its rows."""
    settings, until, latent = posterior.settings, float(rows.time.max()), posterior.latent
    seconds = until - settings.get("learned_until", float(rows.time.min()))
    if seconds < 0.0:
        raise InvalidInput(
            f"these rows end {-seconds:.4g} s before those learned last; with a horizon give rows in the order of time."
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
    likelihood = posterior.likelihood
    training = likelihood.training
    reference = training if training.reference is None else training.reference
    alike = training.correlated_rows
    added = replace(
        TrainingData.of(rows, training.q.device, training.sensed), reference=reference, correlated_rows=alike
    )
    likelihood.model.check_states(added.q, added.v, added.u)
    check_distance(likelihood.model, added)
    return replace(likelihood, training=added, fixed_standardization=likelihood.standardization)


def _require_memory(latent: ExactPosterior, added: int) -> None:
    """Raise NotEnoughMemory where `added` rows do not fit: before anything is computed."""
    count, rank, latents = latent.system.deflation.C.shape
    size, new = rank * (count + added), rank * added
    needed = 8 * (size**2 + 2 * new * size + latents * added**2)  # the new factor, blocks of new rows and their copies
    what = f"a posterior of {count} + {added} rows"
    require_memory(needed, what, "give fewer rows, or a horizon", latent.system.alpha.device)
