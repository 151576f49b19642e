"""What does learning from more rows cost? 10 rows appended to N = 1000 on `kuka-surface` against conditioning on all.

Wall seconds on one thread, medians, both with the dynamics of their rows.

    python -m benchmarks incremental
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable

import torch

from forcegp.data import Dataset, farthest_rows
from forcegp.evidence import MarginalLikelihood, TrainingData
from forcegp.forces import JointForces
from forcegp.inference import OptimizationResult
from forcegp.noise import Noise
from forcegp.posterior import Posterior
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

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


def run() -> dict[str, float]:
    """Measure and print; returns the keys of results.json that this question answers."""
    data = farthest_rows(simulate_kuka_surface(KukaSurfaceConfig(seconds=40.0, seed=1)), 1010)
    return {"update_10_rows_speedup_n1000": update_speed(data)}
