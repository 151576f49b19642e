"""The jobs of the ablation: other searches, a filter, test rows among the training rows."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from forcegp.data import farthest_rows, low_pass
from forcegp.evaluation import evaluate
from forcegp.experiments.data import scored_rows, simulated, training_rows
from forcegp.experiments.fits import MODEL, MODELS
from forcegp.inference import OptimizerOptions
from forcegp.jobs import JobStore
from forcegp.models import Noise, StructuredGP, load_posterior

PAPER_STEPS, PAPER_RATE = 500, 0.2
SCHEDULES = {"maximum-likelihood": "L-BFGS, no hyperprior", "adam-ones": "Adam from ones"}
"""Searches without hyperprior and without restarts; "ones": all length scales and variances begin at 1."""

WINDOW_ROWS, WINDOW_EVERY = 1000, 3


def search(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """One model, one schedule of the search for its hyper-parameters."""
    train = training_rows(results, spec["data"], spec["points"])
    assert train.system is not None
    model = MODELS[spec["model"]].make(train.system)
    options = OptimizerOptions(iterations=spec["iterations"], tolerance=spec["tolerance"])
    start = None
    if spec["schedule"] != "maximum-likelihood":
        options = OptimizerOptions(iterations=0, adam_steps=spec["steps"], adam_rate=PAPER_RATE)
    if spec["schedule"] == "adam-ones":
        begun = model.fit(train, restarts=1, hyperprior=False, options=OptimizerOptions(iterations=0))
        start = {name: torch.zeros_like(x) for name, x in begun.parameters.items() if name.startswith("kernels.")}
    posterior = model.fit(train, restarts=1, hyperprior=False, options=options, start=start)
    scores = evaluate(posterior, scored_rows(results, spec["data"])).to_dict()
    return {"evaluation": scores, "nll": posterior.result.value, "cpu_seconds": posterior.result.cpu_seconds}


def filtered(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """One model on accelerations that were low-pass filtered before the rows were chosen, with learned noise."""
    everything = simulated(spec["seed"], spec["train_seconds"])
    if spec["cutoff"] is not None:
        everything = low_pass(everything, spec["cutoff"], signals=("a",))
    train = farthest_rows(everything, spec["points"])
    assert train.system is not None
    model = StructuredGP(
        train.system, mean="zero" if spec["model"] == "s-gp" else "analytical", noise=Noise(0.1, learn=True)
    )
    options = OptimizerOptions(iterations=spec["iterations"], tolerance=spec["tolerance"])
    posterior = model.fit(train, restarts=1, seed=spec["seed"], options=options)
    return {"evaluation": evaluate(posterior, scored_rows(results, spec["data"])).to_dict()}


def overlap(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A fit tested on a window of its own training trajectory, as the reference implementation does."""
    everything = simulated(spec["seed"], spec["train_seconds"])
    rows = min(WINDOW_ROWS * WINDOW_EVERY, len(everything))
    first = (len(everything) - rows) // 2
    window = everything.rows(slice(first, first + rows, WINDOW_EVERY))
    posterior = load_posterior(results.place(spec["fit"]) / MODEL)
    trained = {tuple(row) for row in np.asarray(posterior.training.q).round(12).tolist()}
    shared = np.mean([tuple(row) in trained for row in window.q.round(12).tolist()])
    evaluation = evaluate(posterior, window)
    return {"mae": evaluation.mae, "mae_noise_free": evaluation.mae_noise_free, "shared": float(shared)}
