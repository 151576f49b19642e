"""What a rig logs: positions with noise and torques, of the free arm with a friction that no model is told."""

from functools import cache

import numpy as np
import torch
from tests.posterior.arm import arm_model, unknown_force

from forcegp.data import Dataset

STEP, SENSOR = 0.002, 2e-5


@cache
def motion(seconds: float = 3.0, seed: int = 0, noise: float = SENSOR) -> Dataset:
    """A smooth motion of the free arm, the torques that make it, and positions with white noise; nothing else."""
    model, generator = arm_model(contacts=0), np.random.default_rng(seed)
    time = STEP * np.arange(round(seconds / STEP))
    rate, phase = generator.uniform(2.0, 8.0, (3, 1, 3)), generator.uniform(0.0, 6.3, (3, 1, 3))
    size, angle = generator.uniform(0.5, 1.0, (3, 1, 3)) / rate, rate * time[:, None] + phase
    q, v = (size * np.sin(angle)).sum(0), (size * rate * np.cos(angle)).sum(0)
    a, states = -(size * rate**2 * np.sin(angle)).sum(0), [torch.tensor(x) for x in (q, v, np.zeros_like(q))]
    dynamics = model.dynamics(*states)
    u = (dynamics.M @ torch.tensor(a)[..., None])[..., 0] - dynamics.Q_K - unknown_force(states[1])
    measured = q + generator.normal(0.0, noise, q.shape)
    return Dataset(
        q=measured,
        v=np.gradient(measured, time, axis=0),
        u=u.numpy(),
        a=np.full_like(measured, 1e3),  # nobody may look at it
        time=time,
        model=model,
        truth={"a": a},
    )
