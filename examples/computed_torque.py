"""Computed torque on the URDF and on learned friction: two links with dry friction follow a reference for 2 s."""

import numpy as np
import torch
from two_links import NOMINAL, TRUE
from two_links_log import recorded

from forcegp import ComputedTorque, JointFriction, fit

DT, PACE, SIZE = 0.01, np.array([3.0, 4.0]), np.array([0.5, 0.4])


def reference(time):
    """Positions, velocities and accelerations."""
    phase = PACE * time
    return [np.pi / 2, 0.0] + SIZE * np.sin(phase), SIZE * PACE * np.cos(phase), -SIZE * PACE**2 * np.sin(phase)


log = recorded()
arm = fit(TRUE, log, points=20).predictor(covariance="none")  # stands for the robot
for name, prior in {"URDF": (), "learned friction": JointFriction()}.items():
    model = fit(NOMINAL.with_forces(prior), log, points=100, restarts=1)
    control = ComputedTorque(model.predictor(covariance="none"), stiffness=100.0, torque_limits=2.0)
    q, v, _ = map(torch.tensor, reference(0.0))
    errors = []
    for k in range(200):
        u = control(q, v, *reference(DT * k))
        for _ in range(5):
            q, v = arm.step(q, v, u, DT / 5, integrator="implicit-midpoint")
        errors.append(q.numpy() - reference(DT * (k + 1))[0])
    print(f"{name}: {1e3 * np.sqrt(np.mean(np.square(errors))):.1f} mrad")
