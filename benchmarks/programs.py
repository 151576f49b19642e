"""What do models cost as programs: predictors of all priors, motions, exported C, CasADi?

`kuka-surface` (iiwa, 7 joints, one plane), 100 points unless said, one thread, both sides in one process; times of one
call are medians of the wall clock. The recommended prior is `gp:joint-friction,gp:load-friction`; others beside it.

* Motions: 512 of 25 steps (4 ms), symplectic Euler. "One by one" are calls of the predictor or of `posterior.rollout`
  for one motion after another, as a loop of a planner makes them; "in batches" the same with 512 states in every call.
* C: `gcc -O2` without `-march`, through ctypes. Parity: of 10,000 states of another recording, against `predict`,
  relative to the largest value.

    python -m benchmarks.programs
"""

from __future__ import annotations

import ctypes
import resource
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from benchmarks.prediction import milliseconds, states
from forcegp import KukaSurfaceConfig, Noise, export_c, fit, simulate_kuka_surface
from forcegp.data import Dataset, farthest_rows
from forcegp.evidence import TrainingData
from forcegp.forces import parse_forces
from forcegp.integration import integrate, integrator_named
from forcegp.posterior import Posterior, casadi_function
from forcegp.posterior.rollout import accelerations

RECOMMENDED = "gp:joint-friction,gp:load-friction"
PRIORS = ("gp:joint", "gp:tool-friction", "gp:joint-friction", RECOMMENDED)
MOTIONS, STEPS, DT, FUNCTIONS = 512, 25, 0.004, 8
PARITY_STATES = 10_000


def fitted(train: Dataset, prior: str, points: int) -> Posterior:
    """With the hyper-parameters of 100 rows."""
    model = train.model
    assert model is not None, "simulated datasets have one"
    first = fit(model.with_forces(parse_forces(prior), noise=Noise(0.1)), train, points=100, restarts=1)
    assert isinstance(first, Posterior), "of processes on forces"
    if points == 100:
        return first
    rows = TrainingData.of(farthest_rows(train, points), model.robot.device)
    settings = {**first.settings, "points": points}
    return Posterior.conditioned(first.trained, rows, first.hyperparameters, first.result, settings)


def seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median of the wall time."""
    call()
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        taken.append(time.perf_counter() - begin)
    return float(np.median(taken))


def predictors(posteriors: dict[tuple[str, int], Posterior], apart: Dataset) -> dict[str, float]:
    """One state, for every prior; the recommended one also at N = 400."""
    results: dict[str, float] = {}
    at = states(apart, 400)
    print(f"{'one state [ms]':>40} {'mean':>8} {'and cov.':>8} {'linearize':>9}")
    for (prior, points), posterior in posteriors.items():
        predictor = posterior.predictor()
        found = [milliseconds(call, at, 1000)[0] for call in (predictor.mean, predictor, predictor.linearize)]
        print(f"{f'{prior}, N = {points}':>40} {found[0]:8.4f} {found[1]:8.4f} {found[2]:9.4f}")
        if prior == RECOMMENDED:
            keys = ("friction_predict_mean_ms", "friction_predict_cov_ms", "friction_linearize_ms")
            for key, value in zip(keys, found, strict=True):
                results[key] = max(value, results.get(key, 0.0))
    return results


def motions(posterior: Posterior, apart: Dataset) -> dict[str, float]:
    """The compiled loop against what a user would write without it."""
    generator = torch.Generator().manual_seed(0)
    q0, v0, u = states(apart, MOTIONS)
    u = u[:, None] + torch.randn(MOTIONS, STEPS, u.shape[1], generator=generator, dtype=torch.float64)
    predictor = posterior.predictor(covariance="none")
    mean = seconds(lambda: predictor.rollouts(q0, v0, u, DT), 20)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of drawn functions some motions diverge
        drawn = seconds(lambda: predictor.rollouts(q0, v0, u, DT, functions=FUNCTIONS), 10)
    two = seconds(lambda: predictor.rollouts(q0, v0, u, DT, threads=2), 20)
    acceleration = accelerations(posterior, posterior.model)
    euler = integrator_named("symplectic-euler", posterior.model)

    def loop(q: torch.Tensor, v: torch.Tensor, forces: torch.Tensor) -> None:
        for k in range(STEPS):
            v = v + DT * predictor.mean(q, v, forces[k])
            q = q + DT * v

    def rolled_out(count: int) -> None:
        with torch.no_grad():
            integrate(euler, acceleration, q0[:count], v0[:count], u[:count].movedim(0, 1), DT)

    one_by_one = MOTIONS / 16 * seconds(lambda: [loop(q0[k], v0[k], u[k]) for k in range(16)], 3)
    batches = seconds(lambda: loop(q0, v0, u.movedim(0, 1)), 5)
    torch_one = MOTIONS * seconds(lambda: rolled_out(1), 5)
    torch_batches = seconds(lambda: rolled_out(MOTIONS), 3)
    print(f"{MOTIONS} motions of {STEPS} steps, compiled loop {1e3 * mean:.2f} ms; times as long:")
    for what, taken in (
        ("predictor, one by one", one_by_one),
        ("predictor, in batches", batches),
        ("posterior.rollout by torch, one by one", torch_one),
        ("posterior.rollout by torch, in batches", torch_batches),
        (f"{FUNCTIONS} drawn functions, each", drawn / FUNCTIONS),
        ("two threads", two),
    ):
        print(f"{what:>44} {taken / mean:10.2f}")
    return {
        "rollout_ms": 1e3 * mean,
        "rollout_vs_predictor_loop": one_by_one / mean,
        "rollout_vs_predictor_batches": batches / mean,
        "rollout_vs_posterior_rollout": torch_one / mean,
        "rollout_vs_posterior_rollout_batches": torch_batches / mean,
        "rollout_functions_cost": drawn / FUNCTIONS / mean,
        "rollout_two_threads": mean / two,
    }


def exported(posterior: Posterior, apart: Dataset, timed: bool) -> dict[str, float]:
    """The C program: compilation, times, parity."""
    at = [np.ascontiguousarray(x) for x in states(apart, PARITY_STATES)]
    expected = posterior.predict(*at, covariance=False).mean.numpy()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        made = export_c(posterior, out, covariance=timed, name="arm", unchecked=True)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = ["gcc", "-std=c99", "-O2", "-fPIC", "-shared", f"{made.name}.c", "-o", "arm.so", "-lm"]
        subprocess.run(command, cwd=out, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        library = ctypes.CDLL(str(out / "arm.so"))
        nv = expected.shape[1]
        a, covariance = np.empty_like(expected), np.empty((nv, nv))
        pointers = [[row.ctypes.data_as(ctypes.c_void_p) for row in x] for x in (*at, a)]
        for q, v, u, result in zip(*pointers, strict=True):
            library.arm_mean(q, v, u, result)
        worst = float(np.abs(a - expected).max() / np.abs(expected).max())
        if not timed:
            return {"c_parity_n1000": worst}
        to = covariance.ctypes.data_as(ctypes.c_void_p)
        calls = list(zip(*pointers, strict=True))[:2000]
        times = {}
        for key, call in (
            ("c_mean_us", lambda given: library.arm_mean(*given)),
            ("c_cov_us", lambda given: library.arm_mean_covariance(*given, to)),
        ):
            taken = []
            for given in calls:
                begin = time.perf_counter()
                call(given)
                taken.append(time.perf_counter() - begin)
            times[key] = 1e6 * float(np.median(taken))
    return times | {"c_parity": worst, "c_compile_cpu_s": after.ru_utime - before.ru_utime}


def casadi_parity(posterior: Posterior, apart: Dataset) -> dict[str, float]:
    """Values and Jacobians at 200 states of another recording."""
    at = states(apart, 200)
    function = casadi_function(posterior)
    jacobian = function.jacobian()
    linear = posterior.predictor(covariance="none").linearize(*at)
    expected, slopes = posterior.predict(*at, covariance=False).mean.numpy(), torch.cat(linear[1:], dim=-1).numpy()
    rows = list(zip(*(x.numpy() for x in at), strict=True))
    a = np.stack([np.array(function(*row)).ravel() for row in rows])
    J = np.stack([np.hstack([np.array(part) for part in jacobian(*row, 0)]) for row in rows])
    return {
        "casadi_parity": float(np.abs(a - expected).max() / np.abs(expected).max()),
        "casadi_jacobian_parity": float(np.abs(J - slopes).max() / np.abs(slopes).max()),
    }


def run() -> dict[str, float]:
    """Measure and print; returns the keys of results.json that this question answers."""
    train, apart = (simulate_kuka_surface(KukaSurfaceConfig(seconds=100.0, seed=seed)) for seed in (31, 1031))
    posteriors = {(prior, 100): fitted(train, prior, 100) for prior in PRIORS}
    posteriors[RECOMMENDED, 400] = fitted(train, RECOMMENDED, 400)
    results = predictors(posteriors, apart)
    results |= motions(posteriors["gp:joint-friction", 100], apart)
    results |= exported(posteriors["gp:joint", 100], apart, True)
    results |= exported(fitted(train, "gp:joint", 1000), apart, False)
    results |= casadi_parity(posteriors[RECOMMENDED, 100], apart)
    for key in ("c_mean_us", "c_cov_us", "c_compile_cpu_s", "c_parity", "c_parity_n1000"):
        print(f"{key:>44} {results[key]:.3g}")
    for key in ("casadi_parity", "casadi_jacobian_parity"):
        print(f"{key:>44} {results[key]:.3g}")
    return results


if __name__ == "__main__":
    torch.set_num_threads(1)
    with threadpool_limits(1):
        run()
