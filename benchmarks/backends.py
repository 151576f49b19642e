"""What do several processes save for the restarts of one fit?

The same fit of `JointForces` to 200 points of `kuka-surface`, eight restarts of at most 20 iterations, in this process
and in two others. Wall-clock seconds, medians of three fits each in turn; every process on one thread. The processes
have done the fit once before (cold).

    python -m benchmarks backends
"""

from __future__ import annotations

import statistics
import time

import torch

from forcegp.fit import fit
from forcegp.forces import JointForces
from forcegp.inference import OptimizerOptions
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

POINTS = 200
RESTARTS = 8
PROCESSES = 2
REPEATS = 3
OPTIONS = OptimizerOptions(iterations=20)


def run() -> dict[str, float]:
    """Measure and print; returns the keys of results.json that this question answers."""
    train = simulate_kuka_surface(KukaSurfaceConfig(seconds=20.0, seed=11))
    model = train.model.with_forces(JointForces())
    jobs = {"serial": 1, "joblib": PROCESSES}
    found: dict[str, dict[str, torch.Tensor]] = {}

    def seconds(name: str) -> float:
        start = time.perf_counter()
        posterior = fit(model, train, points=POINTS, restarts=RESTARTS, options=OPTIONS, jobs=jobs[name])
        found[name] = dict(posterior.hyperparameters)
        return time.perf_counter() - start

    cold = {name: seconds(name) for name in jobs if name != "serial"}
    warm: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(REPEATS):
        for name in jobs:
            warm[name].append(seconds(name))
    medians = {name: statistics.median(each) for name, each in warm.items()}
    print(f"{RESTARTS} restarts, N = {POINTS}: wall-clock seconds")
    print("processes first call   median   lowest  highest")
    for name, each in warm.items():
        first = f"{cold[name]:10.2f}" if name in cold else f"{'':10s}"
        print(f"{name:9s} {first}   {medians[name]:6.2f}   {min(each):6.2f}   {max(each):6.2f}")
    same = all(torch.equal(found[name][key], value) for name in ("joblib",) for key, value in found["serial"].items())
    print(f"parameters identical to the last bit: {same}")
    return {
        "joblib_speedup_8_restarts": medians["serial"] / medians["joblib"],
        "joblib_cold_seconds": cold["joblib"] - medians["joblib"],
        "backends_identical": float(same),
    }
