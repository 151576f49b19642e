"""The direction of gravity that the torques of a log show: they are linear in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from forcegp.checks.torques import SLOW, TorqueFit
from forcegp.data import Dataset
from forcegp.robots import Robot

UNSEEN = 1e-3
"""Singular values below this fraction of the largest belong to directions that no torque shows."""


def estimated_gravity(
    robot: Robot, rows: Dataset, tau: Float[np.ndarray, "rows nv"], fit: TorqueFit
) -> Float[np.ndarray, "3"] | None:
    """Gravity [m/s^2] that leaves least of the torques unexplained, by least squares over all joints.

    Every joint has its friction, armature, constant and factor of inertial torques free, and counts by the spread of
    its torque. Directions that no torque shows stay those of the robot. None where nothing is left to fit.
    """
    nominal = robot.gravity.cpu().numpy()
    q = torch.tensor(rows.q, device=robot.device)
    with torch.no_grad():
        axes = [with_gravity(robot, axis).gravity_forces(q).cpu().numpy() for axis in np.eye(3)]
    pulls = np.stack(axes, axis=-1)  # (rows, nv, 3): torque per m/s^2
    matrices, targets = [], []
    for joint in np.flatnonzero(np.isfinite(fit.unexplained)):
        v, a, u, pull = rows.v[:, joint], rows.a[:, joint], rows.u[:, joint], pulls[:, joint]
        slow = SLOW * np.sqrt(np.square(v).mean()) + 1e-12
        free = np.stack([tau[:, joint] - pull @ nominal, a, v, np.tanh(v / slow), np.ones_like(v)], axis=1)
        basis = np.linalg.qr(free)[0]
        factor = fit.factor[joint] if fit.factor[joint] > 0.0 else 1.0
        weight = 1.0 / max(float(np.std(u)), 1e-12)
        matrices.append(weight * factor * (pull - basis @ (basis.T @ pull)))
        targets.append(weight * (u - basis @ (basis.T @ u)))
    if not matrices:
        return None
    matrix, target = np.concatenate(matrices), np.concatenate(targets)
    estimated = nominal + np.linalg.lstsq(matrix, target - matrix @ nominal, rcond=UNSEEN)[0]
    return estimated if np.linalg.norm(estimated) > 0.0 else None


def with_gravity(robot: Robot, gravity: Float[np.ndarray, "3"]) -> Robot:
    """The same robot under other gravity [m/s^2]."""
    along = torch.as_tensor(gravity, dtype=robot.tree.gravity.dtype, device=robot.device)
    fall = torch.zeros_like(robot.tree.fall)
    fall[:, 3, 0] = along
    return replace(robot, tree=replace(robot.tree, gravity=along, fall=fall))
