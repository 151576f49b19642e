"""A swing-up planned by IPOPT on a model and played on the simulated arm under a time-varying regulator.

The arm, its motors and the recordings are those of `swing_up`. The plan of 2 s in steps of 20 ms obeys the implicit
midpoint rule of `casadi_function(posterior)` and ends upright at rest, with the least torques, at most nine tenths of
the motors'; IPOPT begins with the plan of the URDF. It is played under the linear quadratic regulator of the same
model along the plan (`linearize_step`). The error is the largest angle from upright at the end. Five seeds, medians.

    python -m benchmarks planned_swing_up
"""

from __future__ import annotations

import math
import statistics

import casadi
import numpy as np
import torch

from benchmarks.swing_up import DT, LIMITS, SEEDS, Arm, models, recorded
from forcegp import casadi_function
from forcegp.posterior import Posterior
from forcegp.posterior.predictor import Predictor

STEPS = 100
HANGING, UPRIGHT = np.array([math.pi, 0.0, 0.0, 0.0]), np.zeros(4)


ENOUGH = {"tol": 1e-3, "acceptable_tol": 0.1, "acceptable_constr_viol_tol": 1e-4, "acceptable_iter": 3}
"""IPOPT's tolerances: the slopes of friction curves jump, on which its own (1e-8) are met late or never."""


def planned(posterior: Posterior, start: tuple[np.ndarray, np.ndarray] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """States (STEPS + 1, 4) and torques (STEPS, 2), from another plan or a straight line.

    Raises RuntimeError where IPOPT finds no plan.
    """
    acceleration = casadi_function(posterior)
    problem = casadi.Opti()
    X, U = problem.variable(4, STEPS + 1), problem.variable(2, STEPS)
    middle, change = 0.5 * (X[:, 1:] + X[:, :-1]), (X[:, 1:] - X[:, :-1]) / DT
    problem.subject_to(casadi.vec(change[:2, :] - middle[2:, :]) == 0)
    problem.subject_to(casadi.vec(change[2:, :] - acceleration.map(STEPS)(middle[:2, :], middle[2:, :], U)) == 0)
    problem.subject_to(X[:, 0] == HANGING)
    problem.subject_to(X[:, -1] == UPRIGHT)
    for joint, limit in enumerate(LIMITS):
        problem.subject_to(problem.bounded(-0.9 * limit, U[joint, :], 0.9 * limit))
    problem.minimize(DT * casadi.sumsqr(U) + 0.1 * casadi.sumsqr(U[:, 1:] - U[:, :-1]))
    share = np.linspace(0.0, 1.0, STEPS + 1)
    line = HANGING[:, None] * (1.0 - share) + UPRIGHT[:, None] * share
    problem.set_initial(X, line if start is None else start[0].T)
    problem.set_initial(U, 0.0 if start is None else start[1].T)
    settings = {"print_level": 0, "sb": "yes", "max_iter": 500, "acceptable_obj_change_tol": 1e-3, **ENOUGH}
    problem.solver("ipopt", {"print_time": False}, settings)
    found = problem.solve()
    return np.asarray(found.value(X)).T, np.asarray(found.value(U)).T


def regulator(predictor: Predictor, X: np.ndarray, U: np.ndarray) -> list[np.ndarray]:
    """Gains K_k (2, 4) by the Riccati recursion."""
    Q, R = np.diag([100.0, 100.0, 1.0, 1.0]), 0.01 * np.eye(2)
    P, gains = 10.0 * Q, []
    for x, u in zip(X[-2::-1], U[::-1], strict=True):
        step = predictor.linearize_step(x[:2], x[2:], u, DT, "implicit-midpoint")
        A, B = step.A.numpy(), step.B.numpy()
        K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A - B @ K)
        gains.append(K)
    return gains[::-1]


def end_error(posterior: Posterior, start: tuple[np.ndarray, np.ndarray]) -> float:
    """Largest angle from upright [rad] after the plan was played on the simulated arm."""
    X, U = planned(posterior, start)
    arm, limits = Arm(), np.array(LIMITS)
    for x, u, K in zip(X, U, regulator(posterior.predictor(covariance="none"), X, U), strict=False):
        at = torch.cat([arm.q, arm.v]).numpy()
        arm.step(torch.tensor(np.clip(u - K @ (at - x), -limits, limits)))
    q = arm.q.numpy()
    return float(np.abs((q + math.pi) % (2.0 * math.pi) - math.pi).max())


def run() -> dict[str, float]:
    torch.set_default_dtype(torch.float64)
    errors: dict[str, list[float]] = {}
    for seed in SEEDS:
        found = models(recorded(seed), seed)
        start = planned(found["URDF"])
        for name, posterior in found.items():
            try:
                error = end_error(posterior, start)
            except RuntimeError as cause:
                error = math.inf
                print(f"seed {seed}, {name}: no plan ({str(cause).splitlines()[-1].strip()})")
            errors.setdefault(name, []).append(error)
            print(f"seed {seed}, {name:31s} {error:.4f} rad from upright", flush=True)
    for name, found in errors.items():
        print(f"{name:31s} {statistics.median(found):.4f} rad ({min(found):.4f} to {max(found):.4f})")
    torch.set_default_dtype(torch.float32)
    return {
        "planned_swing_up_learned_rad": statistics.median(errors["learned"]),
        "planned_swing_up_laws_rad": statistics.median(errors["Coulomb's and viscous friction"]),
        "planned_swing_up_urdf_rad": statistics.median(errors["URDF"]),
        "planned_swing_up_true_rad": statistics.median(errors["true"]),
    }
