"""Warnings where a model is tested on what it was trained on."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from forcegp.data import Dataset
from forcegp.models import StructuredPosterior
from forcegp.models.protocol import Posterior


def overlap_warnings(posterior: Posterior, dataset: Dataset) -> tuple[str, ...]:
    """Warnings about rows or trajectories that training and test share, and about contacts that differ."""
    return tuple(_warnings(posterior, dataset))


def shared_rows(posterior: Posterior, dataset: Dataset) -> Int[np.ndarray, " shared"]:
    """Numbers of the rows of `dataset` whose (q, v, u) is exactly that of a training point."""
    training = posterior.training
    trained = {row.tobytes() for row in _inputs(*(getattr(training, name).cpu().numpy() for name in ("q", "v", "u")))}
    rows = _inputs(dataset.q, dataset.v, dataset.u)
    return np.array([number for number, row in enumerate(rows) if row.tobytes() in trained], dtype=np.int64)


def _warnings(posterior: Posterior, dataset: Dataset) -> Iterator[str]:
    repeated = shared_rows(posterior, dataset)
    if repeated.size:
        yield (
            f"{repeated.size} of {len(dataset)} test rows have the very (q, v, u) of training rows (the first: row "
            f"{repeated[0]}); where they are the same rows, these scores flatter the model: test on another trajectory."
        )
    else:
        source = posterior.settings.get("data") or {}
        metadata = json.loads(json.dumps(dataset.metadata))
        shared = sorted(set(source.get("episodes", ())) & set(dataset.episodes))
        if metadata and shared and json.loads(json.dumps(source.get("metadata"))) == metadata:
            yield (
                f"training and test rows come from the same recording (equal metadata, episodes {shared} in both), "
                "so these scores flatter the model; test on another trajectory."
            )
    yield from system_warnings(posterior, dataset)


def system_warnings(posterior: Posterior, dataset: Dataset) -> Iterator[str]:
    """A sentence where predictions are for other contacts or another robot than those of the data, with the remedy."""
    own, model = dataset.system, posterior.system
    if own is None:
        return
    contacts = (own.contacts, own.baumgarte) != (model.contacts, model.baumgarte)
    # inertias that were identified are meant to differ from those that the data came with
    robots = "learned" not in posterior.settings and not own.robot.tree.equals(model.robot.tree)
    if not contacts and not robots:
        return
    what = " and ".join(name for name, differ in (("contacts", contacts), ("robot", robots)) if differ)
    are, those = ("are", "those") if contacts else ("is", "that")
    measured = f"; the constraint error is measured on {those} of the data" if contacts else ""
    remedy = ""
    if isinstance(posterior, StructuredPosterior) and not (robots and posterior.carries_known_forces):
        remedy = (
            "; to predict what the forces do there, carry the model over: posterior.with_system(dataset.system), on "
            "the command line forcegp evaluate --system data"
        )
    yield f"the {what} of the model {are} not {those} of the data{measured}{remedy}"


def _inputs(q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.hstack([q, v, u]) + 0.0  # + 0.0 turns -0.0 into 0.0, so that equal numbers have equal bytes
