"""Check a log: the torque of the elbow has the wrong sign, and the check finds it."""

import numpy as np
import torch
from two_links import NOMINAL

from forcegp import Dataset, check

time = 0.004 * np.arange(2500)
pace = np.array([2.1, 3.3])  # rad/s
phase = np.outer(time, pace)
motion = np.sin(phase), pace * np.cos(phase), -(pace**2) * np.sin(phase)
u = NOMINAL.robot.inverse_dynamics(*map(torch.tensor, motion)).numpy()
u[:, 1] *= -1.0  # the mistake

noise = np.random.default_rng(0)
q = motion[0] + 2e-5 * noise.standard_normal(phase.shape)
v = np.gradient(q, time, axis=0, edge_order=2)
a = np.gradient(v, time, axis=0, edge_order=2)
for doubt in check(Dataset(q=q, v=v, u=u, a=a, time=time, model=NOMINAL)).doubts:
    if doubt.level == "wrong":
        print(f"{doubt.about}: {doubt.what}\n  remedy: {doubt.advice}")
