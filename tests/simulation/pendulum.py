"""A double pendulum with motors: PD control with gravity compensation along sines, and friction in both joints."""

from pathlib import Path

import numpy as np
import torch

from forcegp import Dataset, Model, Robot
from forcegp.forces import Actuation, RigidBodies

RATE, FINE = 240, 4  # rows per second, and steps between two rows
STIFFNESS, MOST = 100.0, 20.0  # 1/s^2, critically damped; Nm
HOME, SIZE, RATES = np.array([0.4, -0.5]), 0.35, (0.8, 3.5)  # rad, rad, rad/s


def friction(v: np.ndarray) -> np.ndarray:
    """Dry friction of 0.4 Nm, 0.6 Nm near rest, and viscous friction of 0.2 Nms/rad."""
    return -((0.4 + 0.2 * np.exp(-((v / 0.1) ** 2))) * np.tanh(v / 0.02) + 0.2 * v)


def double_pendulum(seconds: float, seed: int, noise: float = 0.1) -> Dataset:
    robot = Robot.from_urdf(Path(__file__).with_name("double_pendulum.urdf"))
    plant, rng = robot.compile(), np.random.default_rng([seed, 0])

    def acceleration(q: np.ndarray, v: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """At the row for dt = 0, else of a step that is implicit in friction, to first order: it is stiff."""
        M, h = (x.numpy() for x in plant.mass_matrix_and_bias(torch.tensor(q), torch.tensor(v)))
        slope = dt * np.maximum((friction(v - 1e-6) - friction(v + 1e-6)) / 2e-6, 0.0)
        return np.linalg.solve(M + np.diag(slope), u + friction(v) - h)

    amplitude, w = SIZE * rng.uniform(0.5, 1.0, (2, 2)), rng.uniform(*RATES, (2, 2))
    home, rows = HOME + rng.uniform(-SIZE, SIZE, 2), []
    q, v = home, np.zeros(2)
    for k in range(round(seconds * RATE)):
        t = k / RATE
        ramp, slope = 1.0 - np.exp(-(t**2)), 2.0 * t * np.exp(-(t**2))  # from rest
        x, dx = (amplitude * np.sin(w * t)).sum(0), (amplitude * w * np.cos(w * t)).sum(0)
        wanted = STIFFNESS * (home + ramp * x - q) + 2.0 * STIFFNESS**0.5 * (slope * x + ramp * dx - v)
        M, g = plant.mass_matrix(torch.tensor(q)), plant.gravity_forces(torch.tensor(q))
        u = np.clip(M.numpy() @ wanted + g.numpy(), -MOST, MOST)
        rows.append((q, v, u, acceleration(q, v, u, 0.0), friction(v)))
        for _ in range(FINE):
            v = v + acceleration(q, v, u, 1.0 / (RATE * FINE)) / (RATE * FINE)
            q = q + v / (RATE * FINE)
    q, v, u, a, Q_U = map(np.array, zip(*rows, strict=True))
    measured = a + noise * np.random.default_rng([seed, 0, 1]).standard_normal(a.shape)
    truth = {"a": a, "Q_U": Q_U, "Q_U.joint-friction": Q_U}
    spread = np.full(2, noise) if noise else None
    known = Model(robot, forces=(Actuation(), RigidBodies()))
    return Dataset(q=q, v=v, u=u, a=measured, time=np.arange(len(q)) / RATE, model=known, noise_std=spread, truth=truth)
