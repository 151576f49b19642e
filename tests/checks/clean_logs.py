"""Logs without a mistake, on which nothing may be called wrong: rest, no gravity, contacts, odd friction."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from tests.checks.corruptions import ROBOTS, clean, on_a_line, two_links
from tests.checks.logs import clean as filtered_log
from tests.posterior.arm import arm_model

from forcegp.data import Dataset
from forcegp.model import Model
from forcegp.robots import Robot


def with_motion(robot: Robot, q: np.ndarray, rate: float, seed: int, noise: float = 0.05) -> Dataset:
    """A log of positions given as smooth functions: noise on `a` alone."""
    generator, time = np.random.default_rng(seed), np.arange(len(q)) / rate
    v = np.gradient(q, time, axis=0, edge_order=2)
    a = np.gradient(v, time, axis=0, edge_order=2)
    u = robot.inverse_dynamics(*(torch.tensor(x) for x in (q, v, a))).numpy() + 0.05 * v + 0.1 * np.tanh(v / 0.02)
    noisy = a + noise * generator.normal(size=a.shape)
    stated = np.full(robot.nv, noise) if noise else None
    return Dataset(q=q, v=v, u=u, a=noisy, time=time, model=Model(robot), noise_std=stated)


def rests(robot: Robot, seed: int, noise: float = 0.05, jitter: float = 0.0) -> Dataset:
    """Moves from point to point and waits there; with `jitter` on u, as sensors have it at rest."""
    generator = np.random.default_rng(seed)
    points, rise = np.cumsum(generator.uniform(-0.7, 0.7, (8, robot.nv)), axis=0) * 0.6, np.linspace(0.0, 1.0, 200)
    blend, pieces = 10 * rise**3 - 15 * rise**4 + 6 * rise**5, []
    for start, stop in pairwise(points):
        pieces += [start + blend[:, None] * (stop - start), np.repeat(stop[None], 150, axis=0)]
    data = with_motion(robot, np.concatenate(pieces), 200.0, seed, noise)
    return replace(data, u=data.u + jitter * generator.normal(size=data.u.shape))


def one_rests(robot: Robot, seed: int) -> Dataset:
    return with_motion(robot, clean(robot, seed).q * np.array([1.0, 0.0]) + np.array([0.0, 0.3]), 250.0, seed)


def odd_friction(robot: Robot, seed: int) -> Dataset:
    """Stribeck friction, and friction that depends on the position: what a prior is to learn."""
    data = clean(robot, seed)
    v, q, size = data.v, data.q, np.std(data.u, axis=0)
    force = 0.3 * np.tanh(v / 0.01) * (1.0 + np.exp(-np.square(v / 0.1))) + 0.2 * np.sin(12.0 * q) + 0.1 * v * np.abs(v)
    return replace(data, u=data.u + size * force)


def weightless(seed: int) -> Dataset:
    """No gravity in the log, and none in the model."""
    return clean(two_links(gravity=(0.0, 0.0, 0.0)), seed)


def clean_logs(seed: int) -> Iterator[tuple[str, Dataset]]:
    for name, robot in ROBOTS.items():
        yield name, clean(robot(), seed, noise=("a", "qvu", "none")[seed % 3])
        yield f"{name} rests", rests(robot(), seed)
        yield f"{name} rests, noisy torque", rests(robot(), seed, jitter=0.02)
        yield f"{name} with odd friction", odd_friction(robot(), seed)
    yield "no gravity", weightless(seed)
    yield "a joint is held", one_rests(two_links(), seed)
    yield "on a line", on_a_line(seed)
    yield "on a line, no noise", on_a_line(seed, noise=0.0)
    yield "on a line, few rows", on_a_line(seed).rows(slice(None, None, 40))
    yield "three joints", filtered_log(seed, arm_model(contacts=0))
    yield (
        "rests with noisy positions",
        replace(
            still_noisy := rests(two_links(), seed),
            q=still_noisy.q + 1e-5 * np.random.default_rng(seed).normal(size=still_noisy.q.shape),
        ),
    )
    yield "no noise at all", rests(two_links(), seed, noise=0.0)


def between_postures(robot: Robot, seed: int, seconds: float, share: float = 1.0) -> Dataset:
    """Moves of two seconds, or this share of them, of some joints each, under LuGre friction of 1 Nm."""
    rng, time = np.random.default_rng(seed), np.arange(int(200.0 * seconds)) / 200.0
    count, move = (int(seconds / 2.0) + 2, robot.nv), (time // 2.0).astype(int)
    steps = rng.uniform(0.05, 0.6, count) * rng.choice([-1, 1], count) * (rng.random(count) < 0.7)
    s, P = np.clip((time / 2.0 - move) / share, 0.0, 1.0)[:, None], np.cumsum(steps, 0)
    q = P[move] + (P[move + 1] - P[move]) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    data, bristle, held = with_motion(robot, q, 200.0, seed, 0.0), np.zeros(robot.nv), []
    for v in np.repeat(data.v, 20, axis=0):
        bristle = bristle + (v - abs(v) * bristle / 2e-3) / 4000.0
        held.append(bristle / 2e-3)
    return replace(data, u=data.u + held[19::20] + 0.02 * rng.normal(size=q.shape))
