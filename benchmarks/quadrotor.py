"""A drone in wind that it has not met: force priors against the best parametric model and against an independent GP.

Each seed trains on one flight of 60 s in wind of 4 m/s and tests on four others in 0, 3, 8 and 12 m/s. The lag of the
rotors is known. The parametric model is linear in thrust and torques, drag (linear and
quadratic, along each axis), rates, height and a constant force of the world, with learned variances, from 1,000 rows.
Its observer is the usual one of flight: the mean of the unexplained wrench over a time that predicts the training rows
best. The force prior has the velocity of the air, found and observed, and an observer whose time follows the recording.
"""

import argparse
import json
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from forcegp import AerodynamicForce, Dataset, fit
from forcegp.data import lagged
from forcegp.posterior import Posterior, observing
from forcegp.simulation import QuadrotorConfig, simulate_quadrotor

WINDS = (0.0, 3.0, 8.0, 12.0)
TIMES = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # s
HORIZON, STRIDE = 120, 60  # rows: of .5 s, and between starts


def acting(dataset: Dataset, lag: float) -> Dataset:
    late = lagged(dataset.u, dataset.time, lag)
    keep = np.arange(240, len(dataset))
    return replace(dataset, u=late).rows(keep)


def scores(
    posterior: Posterior,
    dataset: Dataset,
    a: np.ndarray | None = None,
    *,
    horizon: int = HORIZON,
    stride: int = STRIDE,
    begin: int = 60,
    dt: float = 1.0 / 240.0,
) -> tuple[float, float]:
    """nRMSE of accelerations (mean over the columns of `a`, the truth), and RMSE of the position at the end in m.

    From row `begin` on, where the observer has begun.
    """
    a = dataset.truth["a"] if a is None else a
    error = posterior.predict(dataset.q, dataset.v, dataset.u, covariance=False).mean.numpy()[:, : a.shape[1]] - a
    starts = np.arange(begin, len(dataset) - horizon, stride)
    u = np.stack([dataset.u[k : k + horizon] for k in starts])
    moved = posterior.rollout(dataset.q[starts], dataset.v[starts], u, dt)
    away = moved.q[:, -1, :3].numpy() - dataset.q[starts + moved.q.shape[-2] - 1][:, :3]
    return (
        float(np.mean(np.sqrt(np.square(error[begin:]).mean(0)) / a[begin:].std(0))),
        float(np.sqrt(np.square(away).sum(1).mean())) if np.isfinite(away).all() else float("nan"),
    )


def seed_scores(seed: int, lag: float, points: int) -> dict[str, object]:
    train = simulate_quadrotor(QuadrotorConfig(seconds=60.0, seed=seed, lag=lag))
    rows = acting(train, lag)
    tests = [
        acting(simulate_quadrotor(QuadrotorConfig(seconds=20.0, seed=1000 * seed + k, wind=wind, lag=lag)), lag)
        for k, wind in enumerate(WINDS)
    ]
    models: dict[str, Posterior] = {}
    seconds = {}
    for name, learned in {
        "force prior": lambda: fit(train.model.with_forces(AerodynamicForce()), rows, points=points, restarts=1),
        "parametric": lambda: parametric(rows),
        "independent GP": lambda: fit(train.model.black_box(), rows, points=points, restarts=1),
    }.items():
        begun = time.process_time()
        models[name] = learned()
        seconds[name] = round(time.process_time() - begun, 1)
    usual = min(TIMES, key=lambda each: training_error(models["parametric"], rows, each))
    result: dict[str, object] = {"seed": seed, "lag": lag, "fit CPU s": seconds}
    for name, posterior in models.items():
        seconds_back = usual if name == "parametric" else None
        result[name] = [scores(*observing(posterior, test, seconds=seconds_back)) for test in tests]
        if name in ("force prior", "parametric"):
            result[f"{name}, unobserved"] = [scores(posterior, test) for test in tests]
    return {**result, "observer's time of the parametric model": usual}


def parametric(rows: Dataset) -> Posterior:
    """The same without observers of its own."""
    model = rows.model.with_forces(AerodynamicForce(observe=0.0))
    return fit(model, rows, points=1000, restarts=1)


def training_error(posterior: Posterior, rows: Dataset, seconds: float) -> float:
    seeing, seen = observing(posterior, rows, seconds=seconds)
    a = seeing.predict(seen.q, seen.v, seen.u, covariance=False).mean.numpy()
    return float(np.log(np.square(a - seen.a).mean(0)).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--points", type=int, default=300)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    lags = np.random.default_rng(0).uniform(0.04, 0.10, options.seeds)
    results = []
    for seed in range(1, options.seeds + 1):
        results.append(seed_scores(seed, float(round(lags[seed - 1], 3)), options.points))
        print(json.dumps(results[-1]), flush=True)
    ours = np.array([result["force prior"] for result in results])  # (seeds, winds, 2)
    for name, first in results[0].items():
        if isinstance(first, list) and name != "force prior":
            ratio = np.sqrt(np.square(ours).mean(1)) / np.sqrt(np.square([r[name] for r in results]).mean(1))
            print(f"force prior over {name}: accelerations, position after .5 s: {np.median(ratio, 0).round(3)}")
    if options.out:
        options.out.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
