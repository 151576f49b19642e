"""Robots on moving bases. `quadruped` stands, shifts its weight and lifts its feet, with friction and a load.

Its motion is prescribed; joints, torques and foot forces (closest to an even share of the weight) follow exactly.
`quadrotor` follows paths in wind; rotors lag, and air acts on it as no robot file mentions (after Mahony, Kumar &
Corke, IEEE RAM 2012; Faessler et al., RA-L 2018 (drag); Cheeseman & Bennett 1955 (ground)).
"""

import math
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from forcegp.data import Dataset
from forcegp.errors import NumericalError
from forcegp.forces import Actuation, Payload, RigidBodies, Thrusters
from forcegp.forces.rigid_bodies import carrying
from forcegp.mechanics import fixed_point
from forcegp.model import Model
from forcegp.progress import tell
from forcegp.robots import Robot
from forcegp.simulation.scenarios import QuadrotorConfig, QuadrupedConfig
from forcegp.simulation.trajectory import RATE, laws_of_joints, recorded

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


def simulate_quadruped(config: QuadrupedConfig) -> Dataset:
    """Rows of q, v, u and a; truth holds a, the friction Q_U and the foot forces "lambda" in N, world axes."""
    robot = Robot.from_urdf(Path(__file__).parent / "quadruped.urdf", base="floating")
    contacts = tuple(contact for leg in LEGS for contact in fixed_point(f"{leg}_foot", switch=f"{leg}_stands"))
    model = Model(robot, contacts, (Actuation(), RigidBodies()))
    box = config.payload / 12.0 * np.diag([0.1**2 + 0.1**2, 0.2**2 + 0.1**2, 0.2**2 + 0.1**2])  # on its trunk
    loaded = carrying(robot, [Payload("trunk", config.payload, PLACE, box.tolist())]) if config.payload else robot
    steps, parts = max(2, round(config.seconds * RATE)), []
    for episode in range(config.episodes):
        parts.append(_episode(loaded, model, config, episode, steps))
        tell(episode + 1, config.episodes)
    q, v, u, a, Q_U, forces = (torch.cat(part).numpy() for part in zip(*parts, strict=True))
    motion, truth = {"q": q, "v": v, "u": u, "a": a}, {"lambda": forces, "Q_U": Q_U, "Q_U.joint-friction": Q_U}
    load = {"frame": "trunk", "mass": config.payload, "center": list(PLACE)}
    return recorded("quadruped", config, model, motion, truth, {"payload": load})


def _episode(robot: Robot, model: Model, config: QuadrupedConfig, episode: int, steps: int) -> tuple[Tensor, ...]:
    rng = np.random.default_rng([config.seed, episode])
    time, home = torch.arange(steps, dtype=torch.float64) / RATE, robot.neutral()
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
    Q_U = torch.as_tensor(laws_of_joints(str(config.joint_friction), robot, FRICTION)(v.numpy(), q=q.numpy()))
    needed, A = robot.inverse_dynamics(q, v, a) - Q_U, (J * stands[..., None, None]).flatten(1, 2)
    weight, even = -float(robot.gravity[2]) * robot.mass, torch.zeros(steps, len(LEGS), 3, dtype=torch.float64)
    even[..., 2] = weight * stands / stands.sum(-1, keepdim=True)
    even = even.flatten(1)
    left = needed[:, :6] - (A[..., :6].mT @ even[..., None])[..., 0]
    forces = even + (torch.linalg.pinv(A[..., :6].mT, rtol=1e-9) @ left[..., None])[..., 0]
    return q, v, torch.cat([(needed - (A.mT @ forces[..., None])[..., 0])[:, 6:], stands], -1), a, Q_U, forces


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
        kinematics, change = robot.kinematics(q), []
        for k, leg in enumerate(LEGS):
            own = kinematics.frame_jacobian(f"{leg}_foot")[:, :3, 6 + 3 * k : 9 + 3 * k]
            change.append(torch.linalg.solve(own, x[:, k] - kinematics.frame_pose(f"{leg}_foot")[:, :3, 3]))
        q = torch.cat([base, q[:, 7:] + torch.cat(change, -1)], -1)
        if float(torch.cat(change, -1).abs().max()) < 1e-12:
            return q
    raise NumericalError("the feet of the quadruped cannot reach their places; give another seed.")


FINE = 2  # steps between two rows
PLACES = np.array([(0.13, -0.13, 0.02), (-0.13, 0.13, 0.02), (0.13, 0.13, 0.02), (-0.13, -0.13, 0.02)])  # m
TORQUE = 0.016 * np.array([1.0, 1.0, -1.0, -1.0])  # m, on the body about z, to the thrust of a rotor
THRUST, DATASHEET = 1.1e-5, 1.02e-5  # N per (rad/s)^2: the true one, and the one that the model is given
LOWEST, HIGHEST = 150.0, 1000.0  # rad/s
ROTOR_DRAG = np.array([9e-5, 11e-5, 4e-5])  # N per (m/s) and (rad/s), of all rotors
BODY_DRAG = np.array([0.022, 0.034, 0.060])  # N per (m/s)^2
CENTRE = np.array([0.01, -0.006, 0.02])  # m, where the body's drag acts
RADIUS, THROUGH, ACROSS = 0.127, 0.9, 2.0  # m; change of thrust with the advance ratio through and, squared, across
FLAPPING = 0.006  # Nm per m/s of air across the rotors
GUST, MEMORY = 0.12, 2.5  # parts of the mean wind; s
PATH_SIZE, PATH_RATES, ABOVE = np.array([1.6, 1.6, 0.8]), (0.8, 2.4), 1.4  # m, rad/s, m, of sums of two sines
POSITION = 4.0, 3.5, 1.0  # gains of the controller: 1/s^2, 1/s, 1/s^3
TURNING, QUICKEST = 0.5, 12.0  # of attitude: in parts of 1 / lag, and in rad/s


def simulate_quadrotor(config: QuadrotorConfig) -> Dataset:
    """Rows of q, v, commanded rotor speeds u and a; truth holds a and "Q_U", metadata the mean wind of each episode.

    Q_U is all that the model does not contain: what air does, thrust unlike the data sheet, late rotors.
    """
    robot = Robot.from_urdf(Path(__file__).parent / "quadrotor.urdf", base="floating")
    propellers = Thrusters("body", PLACES.tolist(), DATASHEET, (TORQUE * DATASHEET).tolist(), power=2)
    model = Model(robot, (), (Actuation(), propellers, RigidBodies()))
    steps, parts = max(2, round(config.seconds * RATE)), []
    for episode in range(config.episodes):
        parts.append(_flight(robot, config, episode, steps))
        tell(episode + 1, config.episodes)
    q, v, u, a, wind = (np.concatenate(part) for part in zip(*parts, strict=True))
    dynamics = model.dynamics(torch.from_numpy(q), torch.from_numpy(v), torch.from_numpy(u))
    Q_U = (dynamics.M @ torch.from_numpy(a)[..., None])[..., 0] - dynamics.Q_K
    mean = wind.reshape(config.episodes, steps, 3).mean(1).tolist()
    return recorded("quadrotor", config, model, {"q": q, "v": v, "u": u, "a": a}, {"Q_U": Q_U.numpy()}, {"wind": mean})


def _flight(robot: Robot, config: QuadrotorConfig, episode: int, steps: int) -> tuple[np.ndarray, ...]:
    """q, v, u, a and the wind of each row; u holds from its row to the next."""
    rng, dt, body = np.random.default_rng([config.seed, episode]), 1.0 / (RATE * FINE), robot.link("body")
    mass, inertia, gravity = body.mass, body.inertia, robot.gravity.numpy()
    amplitude = PATH_SIZE * rng.uniform(0.3, 0.65, (2, 3))
    rate, phase = rng.uniform(*PATH_RATES, (2, 3)), rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    turn = rng.uniform(0.2, 0.6), rng.uniform(0.0, 2.0 * np.pi)
    heading = rng.uniform(0.0, 2.0 * np.pi)
    mean = config.wind * np.array([math.cos(heading), math.sin(heading), 0.0])
    gust, shock = np.zeros(3), np.array([1.0, 1.0, 0.4]) * GUST * config.wind
    turning = min(QUICKEST, TURNING / config.lag)
    mixer = np.linalg.inv(np.stack([np.ones(4), PLACES[:, 1], -PLACES[:, 0], TORQUE]))

    def path(t: float) -> tuple[np.ndarray, ...]:
        waves = rate * t + phase
        x = (amplitude * np.sin(waves)).sum(0) + np.array([0.0, 0.0, ABOVE])
        return x, (amplitude * rate * np.cos(waves)).sum(0), -(amplitude * rate**2 * np.sin(waves)).sum(0)

    def accelerations(R: np.ndarray, x: np.ndarray, V: np.ndarray, speeds: np.ndarray, air: np.ndarray) -> np.ndarray:
        """Of the base in its own axes, linear then angular."""
        flow = V[:3] - R.T @ air
        across, w = flow * [1.0, 1.0, 0.0], speeds.mean()
        ratio = 1.0 - THROUGH * flow[2] / (w * RADIUS) + ACROSS * (across @ across) / (w * RADIUS) ** 2
        thrust = THRUST * speeds**2 * ratio * (1.0 / (1.0 - 1.5 * (RADIUS / (4.0 * max(x[2], 1.5 * RADIUS))) ** 2))
        drag = -BODY_DRAG * np.linalg.norm(flow) * flow
        force = drag - ROTOR_DRAG * speeds.sum() * flow + [0.0, 0.0, thrust.sum()]
        torque = np.cross(CENTRE, drag) + np.stack([PLACES[:, 1], -PLACES[:, 0], TORQUE]) @ thrust
        torque = torque + FLAPPING * np.array([-flow[1], flow[0], 0.0])
        linear = force / mass + R.T @ gravity - np.cross(V[3:], V[:3])
        return np.concatenate([linear, np.linalg.solve(inertia, torque - np.cross(V[3:], inertia @ V[3:]))])

    x, velocity, _ = path(0.0)
    R, V, missing, rows = np.eye(3), np.concatenate([velocity, np.zeros(3)]), np.zeros(3), []
    speeds = np.full(4, math.sqrt(mass * np.linalg.norm(gravity) / (4.0 * THRUST)))
    settle = RATE * 2  # until it leans against the wind
    for k in range(-settle, steps):
        target, rush, thrown = path(k / RATE)
        error = target - x
        missing = np.clip(missing + error / RATE, -8.0, 8.0)
        wanted = thrown + POSITION[0] * error + POSITION[1] * (rush - R @ V[:3]) + POSITION[2] * missing - gravity
        up, yaw = wanted / np.linalg.norm(wanted), 0.5 * math.sin(turn[0] * k / RATE + turn[1])
        side = np.cross(up, [math.cos(yaw), math.sin(yaw), 0.0])
        side /= np.linalg.norm(side)
        lean = Rotation.from_matrix(R.T @ np.stack([np.cross(side, up), side, up], 1)).as_rotvec()
        moment = inertia @ ((turning**2 * lean - 2.0 * turning * V[3:]) * [1.0, 1.0, 0.3])
        share = mixer @ np.concatenate([[mass * (wanted @ R[:, 2])], moment])
        u, air = np.sqrt(np.clip(share / DATASHEET, LOWEST**2, HIGHEST**2)), mean + gust
        if k >= 0:
            q = np.concatenate([x, Rotation.from_matrix(R).as_quat()])
            rows.append((q, V, u, accelerations(R, x, V, speeds, air), air))
        gust = gust * math.exp(-1.0 / (RATE * MEMORY))
        gust = gust + shock * math.sqrt(2.0 / (RATE * MEMORY)) * rng.standard_normal(3)
        for _ in range(FINE):  # midpoint
            following = u + (speeds - u) * math.exp(-0.5 * dt / config.lag)
            half = V + 0.5 * dt * accelerations(R, x, V, speeds, air)
            middle = R @ Rotation.from_rotvec(0.5 * dt * V[3:]).as_matrix()
            change = accelerations(middle, x + 0.5 * dt * R @ V[:3], half, following, air)
            x, V = x + dt * middle @ half[:3], V + dt * change
            R = R @ Rotation.from_rotvec(dt * half[3:]).as_matrix()
            speeds = u + (speeds - u) * math.exp(-dt / config.lag)
    return tuple(np.array(column) for column in zip(*rows, strict=True))
