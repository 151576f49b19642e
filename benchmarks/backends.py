"""What do several processes save for the restarts of one fit?

The same fit of `JointForces` to 200 points of `kuka-surface`, eight restarts of at most 20 iterations, by each
backend: this process, and two processes of joblib. Wall-clock seconds,
medians of three fits each in turn; every process on one thread. The pool has done the fit once before (cold).

    python -m benchmarks backends
"""

from __future__ import annotations

import statistics
import time

import torch

from forcegp.fit import fit
from forcegp.forces import JointForces
from forcegp.inference import OptimizerOptions
from forcegp.parallel import Backend, Joblib, Serial
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
    backends = {"serial": Serial(), "joblib": Joblib(PROCESSES)}
    found: dict[str, dict[str, torch.Tensor]] = {}

    def seconds(name: str, backend: Backend) -> float:
        start = time.perf_counter()
        posterior = fit(model, train, points=POINTS, restarts=RESTARTS, options=OPTIONS, backend=backend)
        found[name] = dict(posterior.hyperparameters)
        return time.perf_counter() - start

    cold = {name: seconds(name, backend) for name, backend in backends.items() if name != "serial"}
    warm: dict[str, list[float]] = {name: [] for name in backends}
    for _ in range(REPEATS):
        for name, backend in backends.items():
            warm[name].append(seconds(name, backend))
    medians = {name: statistics.median(each) for name, each in warm.items()}
    print(f"{RESTARTS} restarts, N = {POINTS}: wall-clock seconds")
    print("backend   first call   median   lowest  highest")
    for name, each in warm.items():
        first = f"{cold[name]:10.2f}" if name in cold else f"{'':10s}"
        print(f"{name:8s}  {first}   {medians[name]:6.2f}   {min(each):6.2f}   {max(each):6.2f}")
    same = all(torch.equal(found[name][key], value) for name in ("joblib",) for key, value in found["serial"].items())
    print(f"parameters identical to the last bit: {same}")
    return {
        "joblib_speedup_8_restarts": medians["serial"] / medians["joblib"],
        "joblib_cold_seconds": cold["joblib"] - medians["joblib"],
        "backends_identical": float(same),
    }
