"""`quadruped`: stands, shifts its weight and lifts its feet, with friction in every joint and a load.

The motion is prescribed; joints, torques and foot forces (closest to an even share of the weight) follow exactly.
"""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forcegp.data import Dataset
from forcegp.errors import NumericalError
from forcegp.forces import Actuation, RigidBodies
from forcegp.mechanics import fixed_point
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.robots.inertia import physical_of_pseudo_inertia, pseudo_inertia
from forcegp.simulation.joint_friction import LawsOfJoints
from forcegp.simulation.scenarios import QuadrupedConfig
from forcegp.simulation.trajectory import RATE, recorded

LEGS = ("front_left", "front_right", "rear_left", "rear_right")
STANCE = (0.0, 0.75, -1.5)  # roll, hip pitch and knee in rad
SHIFT, TURN = (0.02, 0.015, 0.025), (0.10, 0.10, 0.12)  # of the base in m and rad, sums of two sines
LEAN = (0.07, 0.06)  # m, away from the foot that is lifted, so that the others carry the weight
RATES = (1.5, 5.0)  # of the sines in rad/s
PERIOD, LIFTED, HEIGHT, STRIDE = 3.0, (1.0, 2.0), 0.05, 0.03  # s; between which one foot is up; m
FRICTION = {"level": 0.8, "breakaway": 0.5, "damping": 0.15, "velocity_scale": 0.02, "velocity": 0.15}
"""Of every joint, in Nm, Nms/rad and rad/s."""
PLACE = (0.08, -0.04, 0.12)  # of the load in the trunk, m
NEWTON = 20


def simulate_quadruped(config: QuadrupedConfig, progress: Callable[[int, int], None] | None = None) -> Dataset:
    """Rows of q, v, u and a; truth holds a, the friction Q_U and the foot forces "lambda" in N, world axes."""
    robot = Robot.from_urdf(Path(__file__).parent / "quadruped.urdf", base="floating")
    contacts = tuple(contact for leg in LEGS for contact in fixed_point(f"{leg}_foot", switch=f"{leg}_stands"))
    model = Model(robot, contacts, (Actuation(), RigidBodies()))
    loaded = _loaded(robot, config.payload)
    steps = max(2, round(config.seconds * RATE))
    parts = []
    for episode in range(config.episodes):
        parts.append(_episode(loaded, model, config, episode, steps))
        if progress is not None:
            progress(episode + 1, config.episodes)
    q, v, u, a, Q_U, forces = (torch.cat(part).numpy() for part in zip(*parts, strict=True))
    stands = np.repeat(u[:, -len(LEGS) :], 3, axis=1)
    return recorded(
        "quadruped",
        config,
        model,
        {"q": q, "v": v, "u": u, "a": a},
        {"lambda": forces, "in_contact": stands, "Q_U": Q_U, "Q_U.joint-friction": Q_U},
        {"payload": {"frame": "trunk", "mass": config.payload, "center": list(PLACE)}},
    )


def _loaded(robot: Robot, payload: float) -> Robot:
    """The robot with a box of this mass on its trunk."""
    if not payload:
        return robot
    trunk = robot.link("trunk")
    size = payload / 12.0 * np.diag([0.1**2 + 0.1**2, 0.2**2 + 0.1**2, 0.2**2 + 0.1**2])
    total = pseudo_inertia(trunk.mass, np.array(trunk.center_of_mass), np.array(trunk.inertia))
    total = total + pseudo_inertia(payload, np.array(PLACE), size)
    return robot.with_link("trunk", *physical_of_pseudo_inertia(total))


def _episode(robot: Robot, model: Model, config: QuadrupedConfig, episode: int, steps: int) -> tuple[Tensor, ...]:
    rng = np.random.default_rng([config.seed, episode])
    time = torch.arange(steps, dtype=torch.float64) / RATE
    home = robot.neutral()
    home[7:] = torch.tensor(STANCE * len(LEGS))
    feet = torch.stack([robot.frame_pose(home, f"{leg}_foot")[:3, 3] for leg in LEGS])
    home[2] = -feet[0, 2]
    feet[:, 2] = 0.0
    order = [int(leg) for _ in range(1 + int(time[-1] / PERIOD) // len(LEGS)) for leg in rng.permutation(len(LEGS))]
    order = order if config.lift else []
    q0, V, dV = _base_motion(robot, home, time, rng, order)
    x, dx, ddx, stands = _foot_motion(feet, time, rng, order)
    q = _joint_angles(robot, q0, home, x)
    kinematics = robot.kinematics(q)
    J = torch.stack([kinematics.frame_jacobian(f"{leg}_foot")[:, :3] for leg in LEGS], 1)  # (n, 4, 3, nv)
    own = torch.stack([J[:, k, :, 6 + 3 * k : 9 + 3 * k] for k in range(len(LEGS))], 1)

    def joints(base: Tensor, wanted: Tensor) -> Tensor:
        """Rates of the joints under which the feet have these."""
        return torch.linalg.solve(own, wanted - (J[..., :6] @ base[:, None, :, None])[..., 0]).flatten(1)

    v = torch.cat([V, joints(V, dx)], -1)
    kinematics = robot.kinematics(q, v)
    drift = torch.stack([kinematics.frame_bias_acceleration(f"{leg}_foot")[:, :3] for leg in LEGS], 1)
    a = torch.cat([dV, joints(dV, ddx - drift)], -1)
    friction = LawsOfJoints.named(str(config.joint_friction), robot, FRICTION)
    Q_U = torch.as_tensor(friction(v.numpy()))
    needed = robot.inverse_dynamics(q, v, a) - Q_U
    A = (J * stands[..., None, None]).flatten(1, 2)
    weight = -float(robot.gravity[2]) * robot.mass
    even = torch.zeros(steps, len(LEGS), 3, dtype=torch.float64)
    even[..., 2] = weight * stands / stands.sum(-1, keepdim=True)
    even = even.flatten(1)
    left = needed[:, :6] - (A[..., :6].mT @ even[..., None])[..., 0]
    forces = even + (torch.linalg.pinv(A[..., :6].mT, rtol=1e-9) @ left[..., None])[..., 0]
    torques = (needed - (A.mT @ forces[..., None])[..., 0])[:, 6:]
    return q, v, torch.cat([torques, stands], -1), a, Q_U, forces


def _base_motion(
    robot: Robot, home: Tensor, time: Tensor, rng: np.random.Generator, order: list[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Poses (n, 7) of the base, its velocities and accelerations (n, 6) in its axes."""
    size = torch.tensor([*SHIFT, *TURN]) * torch.tensor(rng.uniform(0.3, 0.7, (2, 6)))
    rate, phase = torch.tensor(rng.uniform(*RATES, (2, 6))), torch.tensor(rng.uniform(0.0, 2.0 * np.pi, (2, 6)))

    away = torch.tensor([[-LEAN[0], -LEAN[1]], [-LEAN[0], LEAN[1]], [LEAN[0], -LEAN[1]], [LEAN[0], LEAN[1]]])
    lean = away[order].double() if order else torch.zeros(1, 2, dtype=torch.float64)
    turn = torch.clamp((time / PERIOD).long(), max=len(lean) - 1)

    def steps(t: Tensor) -> Tensor:
        six = (size * torch.sin(rate * t[:, None, None] + phase)).sum(1)
        bump = torch.sin(math.pi / PERIOD * t[:, None]) ** 4  # at rest, twice, at the ends of a period
        six = six + torch.cat([bump * lean[turn], torch.zeros_like(six[:, 2:])], -1)
        return torch.cat([six, t.new_zeros(len(t), robot.nv - 6)], -1)

    def velocities(t: Tensor) -> Tensor:
        """d step / dt is the matrix of the chart times v, so v solves it."""
        step, change = torch.func.jvp(steps, (t,), (torch.ones_like(t),))[:2]
        return torch.linalg.solve(robot.space.chart_matrix(step)[:, :6, :6], change[:, :6])

    V, dV = torch.func.jvp(velocities, (time,), (torch.ones_like(time),))[:2]
    return robot.space.integrate(home, steps(time))[:, :7], V, dV


def _foot_motion(
    feet: Tensor, time: Tensor, rng: np.random.Generator, order: list[int]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Places, velocities and accelerations (n, 4, 3) of the feet, and which of them stand (n, 4)."""
    n = len(time)
    x = feet.expand(n, -1, -1).clone()
    dx, ddx, stands = torch.zeros_like(x), torch.zeros_like(x), torch.ones(n, len(LEGS), dtype=torch.float64)
    begin, end = LIFTED
    w = 2.0 * np.pi / (end - begin)
    for number, leg in enumerate(order):
        own = (time >= number * PERIOD + begin) & (time < number * PERIOD + end)
        s = w * (time[own] - number * PERIOD - begin)
        reach = torch.tensor([STRIDE * rng.uniform(-1.0, 1.0), STRIDE * rng.uniform(-1.0, 1.0), HEIGHT])
        # up and back with velocities of zero at both ends
        for target, value in ((x, 1.0 - s.cos()), (dx, w * s.sin()), (ddx, w**2 * s.cos())):
            target[own, leg] += 0.5 * value[:, None] * reach
        stands[own, leg] = 0.0
    return x, dx, ddx, stands


def _joint_angles(robot: Robot, base: Tensor, home: Tensor, x: Tensor) -> Tensor:
    """Positions (n, nq) at which the feet are at x, by Newton's method from the posture at home."""
    q = torch.cat([base, home[7:].expand(len(base), -1)], -1)
    for _ in range(NEWTON):
        kinematics = robot.kinematics(q)
        change = []
        for k, leg in enumerate(LEGS):
            missing = x[:, k] - kinematics.frame_pose(f"{leg}_foot")[:, :3, 3]
            own = kinematics.frame_jacobian(f"{leg}_foot")[:, :3, 6 + 3 * k : 9 + 3 * k]
            change.append(torch.linalg.solve(own, missing))
        q = torch.cat([base, q[:, 7:] + torch.cat(change, -1)], -1)
        if float(torch.cat(change, -1).abs().max()) < 1e-12:
            return q
    raise NumericalError("the feet of the quadruped cannot reach their places; give another seed.")
