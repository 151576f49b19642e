"""`quadrotor`: a drone that follows paths in wind; rotors lag, and air acts on it as no robot file mentions.

After Mahony, Kumar & Corke, IEEE RAM 2012; Faessler et al., RA-L 2018 (drag); Cheeseman & Bennett 1955 (ground).
"""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from forcegp.data import Dataset
from forcegp.forces import Actuation, RigidBodies, Thrusters
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.simulation.scenarios import QuadrotorConfig
from forcegp.simulation.trajectory import RATE, recorded

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
SIZE, RATES, HEIGHT = np.array([1.6, 1.6, 0.8]), (0.8, 2.4), 1.4  # m, rad/s and m, of the path: sums of two sines
POSITION = 4.0, 3.5, 1.0  # gains of the controller: 1/s^2, 1/s, 1/s^3
TURNING, QUICKEST = 0.5, 12.0  # of attitude: in parts of 1 / lag, and in rad/s


def simulate_quadrotor(config: QuadrotorConfig, progress: Callable[[int, int], None] | None = None) -> Dataset:
    """Rows of q, v, commanded rotor speeds u and a; truth holds a and "Q_U", metadata the mean wind of each episode.

    Q_U is all that the model does not contain: what air does, a thrust that differs from the data sheet,
    and late rotors.
    """
    robot = Robot.from_urdf(Path(__file__).parent / "quadrotor.urdf", base="floating")
    propellers = Thrusters("body", PLACES.tolist(), DATASHEET, (TORQUE * DATASHEET).tolist(), power=2)
    model = Model(robot, (), (Actuation(), propellers, RigidBodies()))
    steps, parts = max(2, round(config.seconds * RATE)), []
    for episode in range(config.episodes):
        parts.append(_episode(robot, config, episode, steps))
        if progress is not None:
            progress(episode + 1, config.episodes)
    q, v, u, a, wind = (np.concatenate(part) for part in zip(*parts, strict=True))
    dynamics = model.dynamics(torch.from_numpy(q), torch.from_numpy(v), torch.from_numpy(u))
    Q_U = (dynamics.M @ torch.from_numpy(a)[..., None])[..., 0] - dynamics.Q_K
    mean = wind.reshape(config.episodes, steps, 3).mean(1).tolist()
    motion = {"q": q, "v": v, "u": u, "a": a}
    return recorded("quadrotor", config, model, motion, {"Q_U": Q_U.numpy()}, {"wind": mean})


def _episode(robot: Robot, config: QuadrotorConfig, episode: int, steps: int) -> tuple[np.ndarray, ...]:
    """q, v, u, a and the wind of each row; u holds from its row to the next."""
    rng, dt = np.random.default_rng([config.seed, episode]), 1.0 / (RATE * FINE)
    body = robot.link("body")
    mass, inertia, gravity = body.mass, np.array(body.inertia), robot.gravity.numpy()
    amplitude = SIZE * rng.uniform(0.3, 0.65, (2, 3))
    rate, phase = rng.uniform(*RATES, (2, 3)), rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    turn = rng.uniform(0.2, 0.6), rng.uniform(0.0, 2.0 * np.pi)
    heading = rng.uniform(0.0, 2.0 * np.pi)
    mean = config.wind * np.array([math.cos(heading), math.sin(heading), 0.0])
    gust, shock = np.zeros(3), np.array([1.0, 1.0, 0.4]) * GUST * config.wind
    turning = min(QUICKEST, TURNING / config.lag)
    mixer = np.linalg.inv(np.stack([np.ones(4), PLACES[:, 1], -PLACES[:, 0], TORQUE]))

    def path(t: float) -> tuple[np.ndarray, ...]:
        waves = rate * t + phase
        x = (amplitude * np.sin(waves)).sum(0) + np.array([0.0, 0.0, HEIGHT])
        return x, (amplitude * rate * np.cos(waves)).sum(0), -(amplitude * rate**2 * np.sin(waves)).sum(0)

    def accelerations(R: np.ndarray, x: np.ndarray, V: np.ndarray, speeds: np.ndarray, air: np.ndarray) -> np.ndarray:
        """Of the base in its own axes, linear then angular."""
        flow = V[:3] - R.T @ air
        across, w = flow * [1.0, 1.0, 0.0], speeds.mean()
        ratio = 1.0 - THROUGH * flow[2] / (w * RADIUS) + ACROSS * (across @ across) / (w * RADIUS) ** 2
        ground = 1.0 / (1.0 - 1.5 * (RADIUS / (4.0 * max(x[2], 1.5 * RADIUS))) ** 2)
        thrust = THRUST * speeds**2 * ratio * ground
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
        up = wanted / np.linalg.norm(wanted)
        yaw = 0.5 * math.sin(turn[0] * k / RATE + turn[1])
        side = np.cross(up, [math.cos(yaw), math.sin(yaw), 0.0])
        side /= np.linalg.norm(side)
        tilt = np.stack([np.cross(side, up), side, up], 1)
        lean = Rotation.from_matrix(R.T @ tilt).as_rotvec()
        moment = inertia @ ((turning**2 * lean - 2.0 * turning * V[3:]) * [1.0, 1.0, 0.3])
        share = mixer @ np.concatenate([[mass * (wanted @ R[:, 2])], moment])
        u = np.sqrt(np.clip(share / DATASHEET, LOWEST**2, HIGHEST**2))
        air = mean + gust
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
