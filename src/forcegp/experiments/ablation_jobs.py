"""The jobs of the ablation: other searches, the dense formulation, a filter, test rows among the training rows."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp.data import farthest_rows, low_pass
from forcegp.evaluation import evaluate
from forcegp.experiments.data import scored_rows, training_rows
from forcegp.experiments.fits import MODEL, MODELS
from forcegp.inference import OptimizerOptions, minimize_objective
from forcegp.jobs import JobStore
from forcegp.models import MarginalLikelihood, Noise, StructuredGP, TrainingData, load_posterior
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

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
    everything = simulate_kuka_surface(KukaSurfaceConfig(seconds=spec["train_seconds"], seed=spec["seed"]))
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
    everything = simulate_kuka_surface(KukaSurfaceConfig(seconds=spec["train_seconds"], seed=spec["seed"]))
    rows = min(WINDOW_ROWS * WINDOW_EVERY, len(everything))
    first = (len(everything) - rows) // 2
    window = everything.rows(slice(first, first + rows, WINDOW_EVERY))
    posterior = load_posterior(results.place(spec["fit"]) / MODEL)
    trained = {tuple(row) for row in np.asarray(posterior.training.q).round(12).tolist()}
    shared = np.mean([tuple(row) in trained for row in window.q.round(12).tolist()])
    evaluation = evaluate(posterior, window)
    return {"mae": evaluation.mae, "mae_noise_free": evaluation.mae_noise_free, "shared": float(shared)}


def dense(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """CPU time of the paper's schedule in its dense formulation, and of our search to convergence, side by side."""
    train = training_rows(results, spec["data"], spec["points"])
    assert train.system is not None
    training = TrainingData.of(train, train.system.robot.device)
    model = StructuredGP(train.system, mean="zero")
    likelihood = MarginalLikelihood(train.system, model.prior, model.mean, training)
    kernels = likelihood.kernels()
    begin = kernels.initial_parameters()
    noise = Noise(tuple(float(std) for std in np.asarray(train.noise_std))).parameters(train.nv)
    ours = _Deflated(likelihood, noise)
    theirs = _Dense(likelihood, noise)
    difference = _gradient_difference(ours, theirs, begin)
    options = OptimizerOptions(iterations=0, adam_steps=spec["steps"], adam_rate=PAPER_RATE)
    start = time.process_time()
    slow = minimize_objective(theirs, begin, options)
    dense_seconds = time.process_time() - start
    start = time.process_time()
    fast = minimize_objective(ours, begin, OptimizerOptions(iterations=1000, tolerance=spec["tolerance"]))
    return {
        "steps": len(slow.history) - 1,
        "dense_seconds": dense_seconds,
        "dense_nll": slow.value,
        "ours_seconds": time.process_time() - start,
        "ours_nll": fast.value,
        "ours_status": fast.status,
        "ours_converged": fast.converged,
        "ours_iterations": len(fast.history) - 1,
        "gradient_difference": difference,
    }


@dataclass(frozen=True, eq=False)
class _Deflated:
    likelihood: MarginalLikelihood
    noise: Mapping[str, Tensor]

    def __call__(self, parameters: Mapping[str, Tensor]) -> Tensor:
        return self.likelihood(self.likelihood.kernels(), {**self.noise, **parameters})


@dataclass(frozen=True, eq=False)
class _Dense:
    """The same likelihood from the DN x DN covariance: `solve` and `logdet`, each with its LU, and autograd."""

    likelihood: MarginalLikelihood
    noise: Mapping[str, Tensor]

    def __call__(self, parameters: Mapping[str, Tensor]) -> Tensor:
        features, W, residual, noise = self.likelihood.terms({**self.noise, **parameters})
        count, joints, latents = W.shape
        matrices = []
        for c in range(latents):
            lengthscale = parameters[f"kernels.{c}.base_kernel.raw_lengthscale"].exp()
            scaled = features[c] / lengthscale
            squared = scaled.square().sum(-1)
            distance = squared[:, None] + squared[None, :] - 2.0 * scaled @ scaled.mT
            matrices.append(parameters[f"kernels.{c}.raw_outputscale"].exp() * torch.exp(-0.5 * distance))
        weighted = torch.stack(matrices, dim=1)[..., None] * W.permute(2, 0, 1)  # (i, c, j, e)
        S = torch.bmm(W, weighted.reshape(count, latents, count * joints)).reshape(count * joints, count * joints)
        S = S + torch.diag_embed(noise.expand(count, joints).reshape(-1))
        y = residual.reshape(-1)
        return 0.5 * (y @ torch.linalg.solve(S, y) + torch.logdet(S) + y.numel() * math.log(2.0 * math.pi))


def _gradient_difference(ours: _Deflated, theirs: _Dense, begin: Mapping[str, Tensor]) -> float:
    """Largest relative difference of value and gradients at the start."""
    found = []
    for objective in (ours, theirs):
        parameters = {name: value.clone().requires_grad_() for name, value in begin.items()}
        value = objective(parameters)
        gradients = torch.autograd.grad(value, list(parameters.values()))
        found.append(torch.cat([value.detach().reshape(1), *(gradient.reshape(-1) for gradient in gradients)]))
    return float(((found[0] - found[1]).abs() / (1.0 + found[1].abs())).max())
