"""Warnings where a model is tested on what it was trained on."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int

from forcegp.data import Dataset
from forcegp.errors import ForceGPError
from forcegp.mechanics import MechanicalSystem
from forcegp.models import StructuredPosterior
from forcegp.models.protocol import Posterior

TRIED_ROWS = 200
"""Rows on which both systems are tried before one is advised."""

KEPT = "; it stays as it is"

WORTH_MOVING = 0.9
"""Error in the system of the data over that in the model's own, below which the model is worth carrying over."""


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
    tried = _tried(posterior, dataset, own)
    if contacts or not tried.startswith(KEPT):  # a robot that serves these data better than theirs was identified
        yield f"the {what} of the model {are} not {those} of the data{measured}{tried}"


def _tried(posterior: Posterior, dataset: Dataset, system: MechanicalSystem) -> str:
    """What carrying the model over to the system of the data would do to its error, on some of these rows.

    A robot and known forces that were identified are worth more than those that the data came with, and contacts of the
    data more than those of another recording: the rows decide, not a rule.
    """
    if not isinstance(posterior, StructuredPosterior):
        return ""
    rows = dataset.rows(np.unique(np.linspace(0, len(dataset) - 1, TRIED_ROWS).round().astype(int)))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            moved = posterior.with_system(moved_system(posterior, system))
            here, there = (_error(model, rows) for model in (posterior, moved))
    except ForceGPError:
        return ""  # it cannot be carried there
    if there < WORTH_MOVING * here:
        return (
            f"; carried over to them, the error of its mean is {there:.3g} instead of {here:.3g} on "
            f"{len(rows)} of these rows: `posterior.with_system(dataset.system)`"
        )
    return f"{KEPT}, for carried over to them its error would be {there:.3g} instead of {here:.3g}"


def moved_system(posterior: Posterior, system: MechanicalSystem) -> MechanicalSystem:
    """The system of other data, with the robot and known forces of a model that has identified them."""
    if "learned" not in posterior.settings:
        return system
    return replace(posterior.system, contacts=system.contacts, baumgarte=system.baumgarte)


def _error(posterior: Posterior, rows: Dataset) -> float:
    """Mean absolute error of the mean acceleration."""
    with torch.no_grad():
        mean = posterior.predict(rows.q, rows.v, rows.u, covariance=False).mean.cpu().numpy()
    return float(np.abs(mean - rows.a).mean())


def _inputs(q: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.hstack([q, v, u]) + 0.0  # + 0.0 turns -0.0 into 0.0, so that equal numbers have equal bytes
