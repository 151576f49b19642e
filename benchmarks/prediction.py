"""How fast does a trained model predict, one state at a time and many at once, and what does the fast covariance cost?

S-GP + analytical mean of `kuka-surface` (joint prior: 7 processes on 21 features, one plane) on 1000 points, with the
hyper-parameters of a fit to 100 of them. `posterior.predict` is what the predictor is compared with: its times, its
values, its exact standard deviations on two trajectories (the one that the points were chosen from, and one of another
seed). One process, one thread. Times are of the wall clock, for a control loop is one: medians and 99th percentiles.

    python -m benchmarks.prediction
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from forcegp import KukaSurfaceConfig, Noise, fit, simulate_kuka_surface
from forcegp.data import Dataset, farthest_rows
from forcegp.evidence import TrainingData
from forcegp.forces import JointForces
from forcegp.posterior import Posterior
from forcegp.posterior.predictor import Predictor

POINTS, FITTED, BATCH, COMPARED = 1000, 100, 10_000, 400
SEEDS = 31, 1031


def trained() -> tuple[Posterior, Dataset, Dataset]:
    """The posterior, the trajectory of its points, and another one."""
    along, apart = (simulate_kuka_surface(KukaSurfaceConfig(seconds=100.0, seed=seed)) for seed in SEEDS)
    rows = farthest_rows(along, POINTS)
    first = fit(along.model.with_forces(JointForces(), noise=Noise(0.1)), rows.rows(slice(FITTED)), restarts=1)
    training = TrainingData.of(rows, along.model.robot.device)
    settings = {**first.settings, "points": POINTS}
    return first.model.condition(training, first.hyperparameters, first.result, settings), along, apart


def states(dataset: Dataset, count: int) -> list[torch.Tensor]:
    """q, v, u of rows at equal distances, once more from the beginning where there are too few."""
    rows = np.linspace(0, len(dataset) - 1, min(count, len(dataset))).astype(int)
    return [torch.tensor(np.resize(x[rows], (count, x.shape[1]))) for x in (dataset.q, dataset.v, dataset.u)]


def milliseconds(call: Callable[..., Any], at: list[torch.Tensor], repeats: int) -> tuple[float, float]:
    """Median and 99th percentile of the wall time of one call, each at another state."""
    rows = [tuple(x[k] for x in at) for k in range(len(at[0]))]
    for row in rows[:20]:
        call(*row)
    taken = []
    for k in range(repeats):
        row = rows[k % len(rows)]
        begin = time.perf_counter()
        call(*row)
        taken.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(taken)), float(np.quantile(taken, 0.99))


def states_per_second(call: Callable[..., Any], at: list[torch.Tensor]) -> float:
    """Best of three calls with all states."""
    seconds = []
    for _ in range(3):
        begin = time.perf_counter()
        call(*at)
        seconds.append(time.perf_counter() - begin)
    return len(at[0]) / min(seconds)


def inflation(posterior: Posterior, predictor: Predictor, at: list[torch.Tensor]) -> torch.Tensor:
    """Standard deviations of the predictor over the exact ones, minus 1."""
    exact = posterior.predict(*at)
    mean, covariance = predictor(*at)
    difference = float((mean - exact.mean).abs().max() / exact.mean.abs().max())
    print(f"  means differ from those of predict by at most {difference:.1e} of the largest")
    return (covariance.diagonal(dim1=1, dim2=2) / exact.variance).sqrt().flatten() - 1.0


def run() -> dict[str, float]:
    """Measure and print; returns the keys of results.json that this question answers."""
    posterior, along, apart = trained()
    predictor = posterior.predictor()
    print(f"prepared in {predictor.prepare_seconds:.1f} s; rank {predictor.rank}")
    results: dict[str, float] = {"predict_prepare_s": predictor.prepare_seconds, "predict_rank": predictor.rank or 0}
    for name, dataset in (("the trajectory of the points", along), ("another seed", apart)):
        print(f"on {name}:")
        found = inflation(posterior, predictor, states(dataset, COMPARED))
        median, high = (float(found.quantile(level)) for level in (0.5, 0.99))
        print(f"  standard deviations too large by {median:.1e} (median), {high:.1e} (99 %), {float(found.max()):.1e}")
    results |= {"predict_cov_inflation_median": median, "predict_cov_inflation_p99": high}
    at = states(apart, COMPARED)
    print(f"\n{'one state':>40} {'median [ms]':>12} {'99 % [ms]':>10}")
    for what, call, repeats, keys in (
        ("predict, mean", lambda *x: posterior.predict(*x, covariance=False), 300, ("predict_plain_mean_ms", None)),
        ("predict, mean and covariance", posterior.predict, 20, ("predict_plain_cov_ms", None)),
        ("predictor, mean", predictor.mean, 3000, ("predict_mean_ms", "predict_mean_p99_ms")),
        ("predictor, mean and covariance", predictor, 3000, ("predict_cov_ms", "predict_cov_p99_ms")),
        ("predictor, linearize", predictor.linearize, 1000, ("predict_linearize_ms", None)),
    ):
        median, high = milliseconds(call, at, repeats)
        results |= {key: value for key, value in zip(keys, (median, high), strict=True) if key is not None}
        print(f"{what:>40} {median:12.3f} {high:10.3f}")
    at = states(apart, BATCH)
    print(f"\n{f'{BATCH} states':>40} {'states per second':>18}")
    for what, call, key in (
        ("predictor, mean", predictor.mean, "predict_states_per_s_b10000"),
        ("predictor, mean and covariance", predictor, "predict_cov_states_per_s_b10000"),
    ):
        results[key] = states_per_second(call, at)
        print(f"{what:>40} {results[key]:18.0f}")
    return results


if __name__ == "__main__":
    torch.set_num_threads(1)
    with threadpool_limits(1):
        run()
