"""The optimisation of swing_up.py: torques from hanging to upright, by IPOPT."""

import casadi
import numpy as np
from two_links import DT, HANGING, LIMIT, UPRIGHT

from forcegp.posterior import casadi_function

STEPS = 75
SLOW = 1e-3  # what (rad/s)^2 cost beside Nm^2


def plan(posterior):
    """Torques (T, 2) and states (T + 1, 4) from hanging to upright, and how many iterations IPOPT took.

    Least squares of the torques and of their changes; multiple shooting from the straight line at rest.
    """
    step = casadi_function(posterior, steps=DT, integrator="implicit-midpoint")
    U, X = casadi.MX.sym("U", 2, STEPS), casadi.MX.sym("X", 4, STEPS + 1)
    there = casadi.vertcat(*step.map(STEPS)(X[:2, :-1], X[2:, :-1], U))
    rest = casadi.vertcat(casadi.vec(X[:, 1:] - there), X[:, 0] - HANGING, X[:, -1] - UPRIGHT)
    cost = casadi.sumsqr(U) + 0.1 * casadi.sumsqr(U[:, 1:] - U[:, :-1]) + SLOW * casadi.sumsqr(X[2:, :])
    problem = {"x": casadi.vertcat(casadi.vec(U), casadi.vec(X)), "f": cost, "g": rest}
    quiet = {"ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-6, "max_iter": 500}, "print_time": False}
    solve = casadi.nlpsol("plan", "ipopt", problem, quiet)
    straight = HANGING + np.linspace(0, 1, STEPS + 1)[:, None] * (UPRIGHT - HANGING)
    bounds = np.concatenate([np.full(2 * STEPS, LIMIT), np.full(4 * (STEPS + 1), np.inf)])
    found = solve(x0=np.concatenate([np.zeros(2 * STEPS), straight.ravel()]), lbx=-bounds, ubx=bounds, lbg=0, ubg=0)
    x = np.array(found["x"]).ravel()
    if not solve.stats()["success"]:
        raise RuntimeError(solve.stats()["return_status"])
    return x[: 2 * STEPS].reshape(STEPS, 2), x[2 * STEPS :].reshape(-1, 4), solve.stats()["iter_count"]
