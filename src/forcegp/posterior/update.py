"""A fitted model that learns from more rows: exact conditioning at the parameters that it has, in bounded memory."""

from dataclasses import replace
from typing import Any

import torch

from forcegp.data import Dataset
from forcegp.data.views import decided
from forcegp.evidence.likelihood import TrainingData, check_distance
from forcegp.inference import exact
from forcegp.inference.memory import blas_threads, require_memory
from forcegp.inference.posterior import with_rows

Structured = Any
"""A `Posterior`, whose module imports this one."""


def learn_more_rows(posterior: Structured, rows: Dataset) -> Structured:
    """What `Posterior.update` documents."""
    rows = decided(rows)
    latent, training = exact(posterior.latent, "learning from more rows"), posterior.training
    count, rank, latents = latent.system.deflation.C.shape
    size, new = rank * (count + len(rows)), rank * len(rows)
    needed = 8 * (size**2 + 2 * new * size + latents * len(rows) ** 2)  # the factor, blocks of new rows, their copies
    require_memory(needed, f"a posterior of {count} + {len(rows)} rows", "give fewer rows", latent.system.alpha.device)
    # with the standardization at hand instead of one that is computed again
    reference = training if training.reference is None else training.reference
    added = TrainingData.of(rows, training.q.device, training.sensed)
    added = replace(added, reference=reference, correlated_rows=training.correlated_rows)
    known = posterior.likelihood
    known.model.check_states(added.q, added.v, added.u)
    check_distance(known.model, added)
    more = replace(known, training=added, fixed_standardization=known.standardization)
    with torch.no_grad(), blas_threads(training.q.numel()):
        terms = more.terms(posterior.hyperparameters)
        latent = with_rows(latent, terms._replace(noise=terms.noise.expand(len(terms.W), *terms.noise.shape[1:])))
    both = training, more.training
    sensed = {name: torch.cat([x.sensed[name] for x in both]) for name in training.sensed}
    pairs = {name: [getattr(x, name) for x in both] for name in (*"qvua", "strokes")}
    joined = {name: None if any(x is None for x in pair) else torch.cat(pair) for name, pair in pairs.items()}
    likelihood = replace(more, training=replace(training, **joined, sensed=sensed, reference=more.training.reference))
    changes = {"points": len(latent.system.alpha), "rows_added": posterior.settings.get("rows_added", 0) + len(rows)}
    return replace(posterior, likelihood=likelihood, latent=latent).with_settings(**changes)
