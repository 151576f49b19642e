"""An arm with joint friction and friction at its tool, both known to the truth, and models with such priors."""

import dataclasses

import numpy as np
import torch
from tests.posterior.arm import NOISE, arm_data, arm_model

from forcegp.data import Dataset
from forcegp.fit import fit
from forcegp.forces import Unknown
from forcegp.forces.link_forces import ToolPoint
from forcegp.inference import OptimizerOptions
from forcegp.model import Model
from forcegp.posterior import Posterior

VISCOUS = 2.0  # n/(m/s) at the tool


def joint_law(v):
    """Friction of every joint, resisting [Nm]."""
    return 0.8 * np.tanh(v / 0.4) + 0.3 * v


def friction_data(rows: int, seed: int, model: Model | None = None) -> Dataset:
    """Joint friction by `joint_law` and viscous friction at the tool, along the plane, with all of their truth."""
    data = arm_data(rows, seed, model)
    A = data.model.dynamics(*(torch.tensor(x) for x in (data.q, data.v, data.u))).A.numpy()
    along = data.v - (np.linalg.pinv(A) @ A @ data.v[..., None])[..., 0]  # the tool stays on the plane
    data = dataclasses.replace(data, v=along)
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]
    dynamics = data.model.dynamics(*states)
    where = ToolPoint.of(dynamics, "hand", (0.0, 0.0, 0.2))
    velocity, normal = where.velocity(states[1])[:, :3], torch.tensor([0.2, 0.0, 1.0], dtype=torch.float64)
    normal = normal / normal.norm()
    force = -VISCOUS * (velocity - (velocity @ normal)[:, None] * normal)
    tool, joints = (where.jacobian[:, :3].mT @ force[..., None])[..., 0], -torch.tensor(joint_law(data.v))
    a = dynamics.acceleration(tool + joints).numpy()
    truth = {
        "a": a, "lambda": dynamics.multiplier(tool + joints).numpy(), "Q_U": (tool + joints).numpy(),
        "Q_U.tool-friction": tool.numpy(), "force.tool-friction": force.numpy(), "Q_U.joint-friction": joints.numpy(),
    }  # fmt: skip
    return dataclasses.replace(data, a=a + np.random.default_rng(seed + 100).normal(0.0, NOISE, a.shape), truth=truth)


def fitted(*forces: Unknown, points: int = 40, iterations: int = 60, mean: bool = True) -> Posterior:
    """A model of that arm with these forces, with known forces as their mean or without."""
    data, model = friction_data(points, seed=0), arm_model().with_forces(*forces)
    options = OptimizerOptions(iterations=iterations)
    return fit(model if mean else model.without_mean(), data, restarts=1, options=options)
