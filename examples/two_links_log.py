"""Logs of the two links with their true friction: a generator of data, used by the other examples."""

import numpy as np
import torch
from two_links import DT, NOMINAL, TRUE

from forcegp import Dataset
from forcegp.integration import integrate, integrator_named


def acceleration(q, v, u):
    """Of the true arm, for states (n, 2)."""
    return TRUE.dynamics(q, v, u).acceleration(torch.zeros_like(q))


def recorded(count=12, steps=100, noise=0.2):
    """Motions of 2 s under sums of sinusoidal torques, every other row, accelerations with noise."""
    generator = np.random.default_rng(0)
    time = DT * np.arange(steps)
    size = generator.uniform(0.07, 0.17, (count, 1, 2)) * [1.0, 0.6]
    frequency, phase = generator.uniform(0.5, 2.0, (count, 3, 2)), generator.uniform(0.0, 2 * np.pi, (count, 3, 2))
    turns = 2 * np.pi * frequency[:, :, None] * time[:, None] + phase[:, :, None]
    u = torch.as_tensor((size[:, None] * np.sin(turns)).sum(1))
    q0 = torch.tensor(np.stack([generator.uniform(-3, 3, count), generator.uniform(-2, 2, count)], axis=1))
    rule = integrator_named("implicit-midpoint", TRUE)
    motion = integrate(rule, acceleration, q0, torch.zeros_like(q0), u.movedim(1, 0), DT)
    q, v, u = (x[:, :steps:2].reshape(-1, 2) for x in (motion.q.movedim(0, 1), motion.v.movedim(0, 1), u))
    a = acceleration(q, v, u).numpy() + generator.normal(0.0, noise, q.shape)
    given = {"time": np.tile(time[::2], count), "episode": np.repeat(np.arange(count), steps // 2)}
    q, v, u = (x.numpy() for x in (q, v, u))
    return Dataset(q=q, v=v, u=u, a=a, model=NOMINAL, noise_std=np.full(2, noise), **given)
