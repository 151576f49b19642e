"""Swing up two links by random shooting at 50 Hz: 512 motions of 25 steps under learned friction before every step.

Model-predictive path integral control (Williams, Aldrich & Theodorou 2017) in its plainest form.
"""

import time

import numpy as np
import torch
from true_arm import TrueArm
from two_links import DT, HANGING, LIMIT, NOMINAL, UPRIGHT
from two_links_log import recorded

from forcegp import JointFriction, fit

MOTIONS, STEPS, SPREAD, KEPT = 512, 25, 0.15, 0.8  # Nm, and how much of a random torque the next step keeps
torch.set_num_threads(1)
data, generator = recorded(), torch.Generator().manual_seed(0)
learned = fit(NOMINAL.with_forces(JointFriction()), data, points=120, restarts=1)
predictor, arm = learned.predictor(covariance="none"), TrueArm(data)
state, torques, taken = HANGING, torch.zeros(STEPS, 2, dtype=torch.float64), []
for _ in range(round(3.0 / DT)):
    begin = time.process_time()
    noise = SPREAD * torch.randn(MOTIONS, STEPS, 2, dtype=torch.float64, generator=generator)
    for k in range(1, STEPS):
        noise[:, k] = KEPT * noise[:, k - 1] + (1 - KEPT**2) ** 0.5 * noise[:, k]
    u = (torques + noise).clamp(-LIMIT, LIMIT)
    moved = predictor.rollouts(state[:2], state[2:], u, DT, integrator="implicit-midpoint", threads=1)
    away = moved.q.cumsum(-1) - UPRIGHT[0]  # angles of both links in space
    cost = (1 - away.cos()).sum((1, 2)) + 3e-3 * moved.v.square().sum((1, 2)) + 0.1 * u.square().sum((1, 2))
    weights = torch.softmax(-(cost.nan_to_num(torch.inf) - cost.nan_to_num(torch.inf).min()) / 0.3, dim=0)
    torques = (weights[:, None, None] * u).sum(0)
    taken.append(time.process_time() - begin)
    state, torques = arm(state, torques[:1])[-1], torch.cat([torques[1:], torques[-1:]])
up = np.cos(state[:2].cumsum() - UPRIGHT[0])
print(f"cosines of the angles between links and upright after 3 s: {up[0]:.2f}, {up[1]:.2f}")
print(f"median {1e3 * np.median(taken):.1f} ms of CPU, of {1e3 * DT:.0f} ms, for {MOTIONS} x {STEPS} steps")
