"""Swing up two light links with dry friction: friction learned from motions, torques planned by IPOPT.

Needs `pip install 'forcegp[casadi]'`; writes swing-up.png. docs/deploy.md explains it.
"""

import casadi
import matplotlib.pyplot as plt
import numpy as np
import torch

from forcegp import Actuation, Dataset, JointFriction, MechanicalSystem, NoForces, RigidBodyBias, Robot, StructuredGP
from forcegp.integration import integrate, integrator_named
from forcegp.mechanics import StribeckJointFriction
from forcegp.models import casadi_function

LINK = """<link name="{name}"><inertial><origin xyz="0.1 0 0"/><mass value="0.1"/>
<inertia ixx="0.003" iyy="0.003" izz="0.003" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="continuous"><origin xyz="{x} 0 0"/><parent link="{parent}"/>
<child link="{child}"/><axis xyz="0 1 0"/></joint>"""
URDF = '<robot name="two links"><link name="base"/>' + "".join(
    [
        LINK.format(name="upper"),
        LINK.format(name="fore"),
        JOINT.format(name="shoulder", x=0, parent="base", child="upper"),
        JOINT.format(name="elbow", x=0.2, parent="upper", child="fore"),
    ]
)
ROBOT = Robot.from_urdf_text(URDF + "</robot>")
NOMINAL = MechanicalSystem(ROBOT, (), (Actuation(), RigidBodyBias()))
FRICTION = StribeckJointFriction(coulomb=0.1, static=0.15, stribeck_velocity=0.1, velocity_scale=0.1)  # Nm, rad/s
TRUE = MechanicalSystem(ROBOT, (), (Actuation(), RigidBodyBias(), FRICTION))
HANGING, UPRIGHT = np.array([np.pi / 2, 0.0, 0.0, 0.0]), np.array([-np.pi / 2, 0.0, 0.0, 0.0])  # [q, v]
DT, STEPS = 0.02, 75
SLOW = 1e-3  # what (rad/s)^2 cost beside Nm^2
LIMIT = 0.45  # Nm; gravity needs 0.39 Nm at the shoulder where the arm is level


def acceleration(q, v, u):
    """What no model is told, for states (n, 2)."""
    return TRUE.dynamics(q, v, u).acceleration(torch.zeros_like(q))


def motions(q0, v0, u, dt):
    """q, v (n, T + 1, 2) of the true arm under torques u (n, T, 2), each held for dt."""
    q0, v0, u = (torch.as_tensor(x) for x in (q0, v0, u))
    found = integrate(integrator_named("implicit-midpoint", TRUE), acceleration, q0, v0, u.movedim(1, 0), dt)
    return found.q.movedim(0, 1), found.v.movedim(0, 1)


def recorded(count=12, steps=100, noise=0.2):
    """Motions of 2 s under sums of sinusoidal torques, every other row, accelerations with noise."""
    generator = np.random.default_rng(0)
    time = DT * np.arange(steps)
    size = generator.uniform(0.07, 0.17, (count, 1, 2)) * [1.0, 0.6]
    frequency, phase = generator.uniform(0.5, 2.0, (count, 3, 2)), generator.uniform(0.0, 2 * np.pi, (count, 3, 2))
    turns = 2 * np.pi * frequency[:, :, None] * time[:, None] + phase[:, :, None]
    u = (size[:, None] * np.sin(turns)).sum(1)
    q0 = np.stack([generator.uniform(-3, 3, count), generator.uniform(-2, 2, count)], axis=1)
    q, v = motions(q0, np.zeros_like(q0), u, DT)
    rows = [x[:, :steps:2].reshape(-1, 2) for x in (q, v, torch.as_tensor(u))]
    a = acceleration(*rows).numpy() + generator.normal(0.0, noise, rows[0].shape)
    episode = np.repeat(np.arange(count), steps // 2)
    q, v, u = (x.numpy() for x in rows)
    given = {"episode": episode, "system": NOMINAL, "noise_std": np.full(2, noise)}
    return Dataset(q=q, v=v, u=u, a=a, time=np.tile(time[::2], count), **given)


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


def replay(truth, u, substeps=10):
    """States (T + 1, 4) of the true arm under planned torques, in shorter steps than those of the plan."""
    start, fine = torch.as_tensor(HANGING), np.repeat(u, substeps, axis=0)
    true = truth.predictor(covariance="none").rollouts(
        start[:2], start[2:], fine, DT / substeps, integrator="implicit-midpoint"
    )
    return torch.cat([true.q, true.v], dim=-1)[::substeps].numpy()


def picture(plans, path="swing-up.png"):
    """Planned joint angles, those of the true arm under the planned torques, and these torques."""
    time, names = DT * np.arange(STEPS + 1), ROBOT.joint_names
    figure, axes = plt.subplots(3, len(plans), figsize=(10, 8), sharex=True, sharey="row", layout="constrained")
    for column, (title, (u, states, true)) in zip(axes.T, plans.items(), strict=True):
        for joint, axis in enumerate(column[:2]):
            axis.plot(time, states[:, joint], "--", color="C0", label="planned")
            axis.plot(time, true[:, joint], color="C1", label="true arm under the planned torques")
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
    truth = StructuredGP(TRUE, NoForces()).fit(data, points=20, restarts=1)  # to let the true arm move fast
    plans = {}
    for title, posterior in (("planned without friction", nominal), ("planned with learned friction", learned)):
        u, states, iterations = plan(posterior)
        true = replay(truth, u)
        off = abs(true[:, :2] - states[:, :2]).max(1)
        print(f"{title}: {iterations} iterations, {off[-1]:.2f} rad off at the end, at most {off.max():.2f} rad")
        plans[title] = u, states, true
    picture(plans)


if __name__ == "__main__":
    main()
