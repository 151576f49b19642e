"""What does learning from more rows cost, and which rows are worth keeping?

Two questions on `kuka-surface` (analytical mean, one process per joint):

* 10 rows appended to N = 1000 (`posterior.update`) against conditioning on all 1010 rows, both with the dynamics of
  their rows; wall seconds on one thread, medians.
* A stream: 2000 rows of one trajectory (100 s, every 12th row). Hyper-parameters are fitted to its first 200 rows, the
  others arrive 20 at a time under a budget of 200 rows, and the mean absolute error against the noise-free acceleration
  is taken on another trajectory of 60 s. Rules: keep the newest rows; rows that lie far apart in (q, v, u); rows that
  move the posterior most (`divergence`, the default). In hindsight: conditioning at once on the 200 of all 2000 rows
  that lie farthest apart. Three seeds, median.

    python -m benchmarks incremental
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch

from forcegp.data import Dataset, farthest_point_sampling, farthest_rows
from forcegp.evidence import MarginalLikelihood, TrainingData
from forcegp.fit import fit
from forcegp.forces import JointForces
from forcegp.inference import ExactPosterior, OptimizationResult, OptimizerOptions
from forcegp.inference.cholesky_update import rows_to_keep
from forcegp.noise import Noise
from forcegp.posterior import Posterior
from forcegp.posterior.update import learn_more_rows
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

SEEDS = (1, 2, 3)
BUDGET, BATCH, STREAM, FIRST = 200, 20, 2000, 200
REPEATS = 5
NO_SEARCH = OptimizationResult({}, math.nan, (), "not searched", False, 0, 0.0)


def median_seconds(call: Callable[[], object], repeats: int = REPEATS) -> float:
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def conditioned(data: Dataset) -> Posterior:
    """On all rows, at the start values of a search."""
    model = data.model.with_forces(JointForces(), noise=Noise(0.1))
    training = TrainingData.of(data, torch.device("cpu"))
    parameters = MarginalLikelihood(model, training).kernels.initial_parameters()
    return Posterior.conditioned(model, training, parameters | Noise(0.1).parameters(data.nv), NO_SEARCH, {})


def update_speed(data: Dataset) -> float:
    posterior = conditioned(data.rows(slice(0, 1000)))
    both, more = data.rows(slice(0, 1010)), data.rows(slice(1000, 1010))
    _ = posterior.likelihood.standardization
    update = median_seconds(lambda: posterior.update(more))
    whole = median_seconds(lambda: conditioned(both), 3)
    print(
        f"10 rows appended to 1000: {update:.3f} s; all 1010 conditioned on: {whole:.3f} s; {whole / update:.1f} times"
    )
    return whole / update


def far_apart(latent: ExactPosterior, budget: int) -> torch.Tensor:
    return torch.tensor(np.sort(farthest_point_sampling(latent.features[0].numpy(), budget)))  # standardised (q, v, u)


RULES: dict[str, Callable[[ExactPosterior, int], torch.Tensor]] = {
    "newest": lambda latent, budget: torch.arange(len(latent.features[0]) - budget, len(latent.features[0])),
    "farthest": far_apart,
    "divergence": rows_to_keep,
}


def error(posterior: Posterior, test: Dataset) -> float:
    mean = posterior.predict(test.q, test.v, test.u, covariance=False).mean
    return float((mean - torch.tensor(test.truth["a"])).abs().mean())


def streams() -> dict[str, float]:
    found: dict[str, list[float]] = {}
    print(f"seed {'rule':>12}  noise-free MAE [rad/s^2]   s per update of {BATCH} rows")
    for seed in SEEDS:
        stream = simulate_kuka_surface(KukaSurfaceConfig(seconds=100.0, seed=seed)).rows(slice(0, 12 * STREAM, 12))
        test = simulate_kuka_surface(KukaSurfaceConfig(seconds=60.0, seed=1000 + seed)).rows(slice(0, None, 20))
        options = OptimizerOptions(iterations=60)
        first = fit(stream.model.with_forces(JointForces()), stream.rows(slice(0, FIRST)), restarts=1, options=options)
        hindsight = TrainingData.of(farthest_rows(stream, BUDGET), torch.device("cpu"))
        at_once = first.model.condition(
            TrainingData(hindsight.q, hindsight.v, hindsight.u, hindsight.a, reference=first.training),
            first.hyperparameters,
            NO_SEARCH,
            {},
        )
        scores = {"first_rows": (error(first, test), 0.0), "hindsight": (error(at_once, test), 0.0)}
        for name, rule in RULES.items():
            posterior = first
            start = time.perf_counter()
            for row in range(FIRST, STREAM, BATCH):
                posterior = learn_more_rows(posterior, stream.rows(slice(row, row + BATCH)), BUDGET, rule)
            seconds = (time.perf_counter() - start) / ((STREAM - FIRST) / BATCH)
            scores[name] = error(posterior, test), seconds
        for name, (score, seconds) in scores.items():
            print(f"{seed:4d} {name:>12}  {score:.4f}                    {seconds:.3f}", flush=True)
            found.setdefault(name, []).append(score)
    return {f"stream_mae_{name}_b{BUDGET}": statistics.median(values) for name, values in found.items()}


def run() -> dict[str, float]:
    """Measure and print; returns the keys of results.json that this question answers."""
    data = farthest_rows(simulate_kuka_surface(KukaSurfaceConfig(seconds=40.0, seed=1)), 1010)
    return {"update_10_rows_speedup_n1000": update_speed(data), **streams()}
