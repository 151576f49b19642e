"""Swing up two links: friction learned from motions, torques planned by IPOPT; docs/deploy.md explains it.

Needs `pip install 'forcegp[casadi]' matplotlib`; writes swing-up.png.
"""

import casadi
import matplotlib.pyplot as plt
import numpy as np
from two_links import DT, HANGING, LIMIT, NOMINAL, ROBOT, UPRIGHT, TrueArm, recorded

from forcegp import JointFriction, NoForces, StructuredGP
from forcegp.models import casadi_function

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


def picture(plans, path="swing-up.png"):
    """Planned joint angles, those of the true arm under the planned torques, and these torques."""
    time, names = DT * np.arange(STEPS + 1), ROBOT.joint_names
    figure, axes = plt.subplots(3, len(plans), figsize=(10, 8), sharex=True, sharey="row", layout="constrained")
    for column, (title, (u, states, true)) in zip(axes.T, plans.items(), strict=True):
        for joint, axis in enumerate(column[:2]):
            axis.plot(time, true[:, joint], color="C1", linewidth=3, label="true arm under the planned torques")
            axis.plot(time, states[:, joint], "--", color="C0", label="planned")
            axis.axhline(UPRIGHT[joint], color="0.6", linewidth=0.8, zorder=0)
            axis.set_ylabel(f"{names[joint]} [rad]")
        for joint, name in enumerate(names):
            column[2].stairs(u[:, joint], time, baseline=None, color=f"C{2 + joint}", label=name)
        for limit in (-LIMIT, LIMIT):
            column[2].axhline(limit, color="0.6", linewidth=0.8, zorder=0)
        column[2].set_ylabel("torque [Nm]")
        column[2].set_xlabel("time [s]")
        column[0].set_title(title)
    for axis in axes[[0, 2], 0]:
        axis.legend(loc="best", fontsize="small")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main():
    """Learn, plan with and without what was learned, and let the true arm do both."""
    data = recorded()
    learned = StructuredGP(NOMINAL, JointFriction()).fit(data, points=120, restarts=1)
    nominal = StructuredGP(NOMINAL, NoForces()).fit(data, points=20, restarts=1)
    arm, plans = TrueArm(data), {}
    for title, posterior in (("planned without friction", nominal), ("planned with learned friction", learned)):
        u, states, iterations = plan(posterior)
        true = arm(HANGING, u)
        off = abs(true[:, :2] - states[:, :2]).max(1)
        print(f"{title}: {iterations} iterations, {off[-1]:.2f} rad off at the end, at most {off.max():.2f} rad")
        plans[title] = u, states, true
    picture(plans)


if __name__ == "__main__":
    main()
