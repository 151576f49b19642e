"""An arm with joint friction and friction at its tool, both known to the truth, and models with such priors."""

import dataclasses

import numpy as np
import torch
from tests.models.arm import NOISE, arm_data, arm_system

from forcegp.data import Dataset
from forcegp.inference import OptimizerOptions
from forcegp.mechanics import MechanicalSystem
from forcegp.models import StructuredGP, StructuredPosterior
from forcegp.priors import ForcePrior
from forcegp.priors.tool_forces import ToolPoint

VISCOUS = 2.0
"""N/(m/s) at the tool."""


def joint_law(v):
    """Friction of every joint, resisting [Nm]."""
    return 0.8 * np.tanh(v / 0.4) + 0.3 * v


def friction_data(rows: int, seed: int, system: MechanicalSystem | None = None) -> Dataset:
    """Joint friction by `joint_law` and viscous friction at the tool, along the plane, with all of their truth."""
    data = arm_data(rows, seed, system)
    A = data.system.dynamics(*(torch.tensor(x) for x in (data.q, data.v, data.u))).A.numpy()
    along = data.v - (np.linalg.pinv(A) @ A @ data.v[..., None])[..., 0]  # the tool stays on the plane
    data = dataclasses.replace(data, v=along)
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]
    dynamics = data.system.dynamics(*states)
    where = ToolPoint.of(dynamics, "hand", (0.0, 0.0, 0.2))
    velocity = where.velocity(states[1])[:, :3]
    normal = torch.tensor([0.2, 0.0, 1.0], dtype=torch.float64)
    normal = normal / normal.norm()
    force = -VISCOUS * (velocity - (velocity @ normal)[:, None] * normal)
    tool = (where.jacobian[:, :3].mT @ force[..., None])[..., 0]
    joints = -torch.tensor(joint_law(data.v))
    a = dynamics.acceleration(tool + joints).numpy()
    truth = {
        "a": a,
        "lambda": dynamics.multiplier(tool + joints).numpy(),
        "Q_U": (tool + joints).numpy(),
        "Q_U.tool-friction": tool.numpy(),
        "force.tool-friction": force.numpy(),
        "Q_U.joint-friction": joints.numpy(),
    }
    noise = np.random.default_rng(seed + 100).normal(0.0, NOISE, a.shape)
    return dataclasses.replace(data, a=a + noise, truth=truth)


def fitted(prior: ForcePrior, points: int = 40, iterations: int = 60, **changes) -> StructuredPosterior:
    """A model of that arm with this prior."""
    data = friction_data(points, seed=0)
    return StructuredGP(arm_system(), prior, **changes).fit(
        data, restarts=1, options=OptimizerOptions(iterations=iterations)
    )
