"""What friction leaves of the accelerations under given contacts, by linear least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import forcegp.mechanics
from forcegp.data.dataset import Dataset

MANY_ROWS = 40
"""From which on friction may also turn a link about the normal of a contact."""

BLOCKS = 6
"""Stretches that are left out in turn, for standard deviations."""

STEP = 1e-3  # m
SLOW = 0.1
"""Of the root mean square velocity: where dry friction turns over."""

FLOOR = 1e-14


def tensors(rows: Dataset) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """q, v, u and a of the rows."""
    return tuple(torch.tensor(getattr(rows, name)) for name in "qvua")  # type: ignore[return-value]


class Residual:
    """Accelerations that friction and some more columns leave of `a` under a system's contacts, joint by joint.

    `friction` (rows, nv, k) are joint forces of the friction that may be there (default: of joints and contacts),
    `more` the same system with something moved by STEP, whose effect is one more column each.
    """

    def __init__(
        self,
        rows: Dataset,
        system: forcegp.mechanics.MechanicalSystem,
        friction: Float[Tensor, "rows nv k"] | None = None,
        more: Sequence[forcegp.mechanics.MechanicalSystem] = (),
    ) -> None:
        q, v, u, a = tensors(rows)
        dynamics = system.dynamics(q, v, u)
        given = dynamics.acceleration_map().offset
        self.friction = _friction(rows, system, dynamics) if friction is None else friction
        moved = [(other.dynamics(q, v, u).acceleration_map().offset - given) / STEP for other in more]
        columns = torch.cat([dynamics.H @ self.friction, *(each[..., None] for each in moved)], dim=-1)
        self.extra = len(moved)
        parts = torch.cat([columns, (a - given)[..., None]], dim=-1).numpy()
        size = np.linalg.norm(parts, axis=(0, 1))
        self.used = size > 1e-9 * max(float(size.max()), 1e-300)
        self.used[-1] = True
        self.size = np.where(self.used, np.maximum(size, 1e-300), 1.0)
        self.blocks = np.array_split(parts / self.size * self.used, BLOCKS)
        self.count = len(rows)

    def grams(self) -> Float[np.ndarray, "blocks nv k k"]:
        """Products of all columns, the residual last, for successive blocks of rows."""
        return np.stack([np.einsum("rjk,rjl->jkl", block, block) for block in self.blocks])

    def solved(
        self, gram: Float[np.ndarray, "nv k k"], weights: Float[np.ndarray, " nv"], extra: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients (k,), and the power (nv,) that is left in every joint; with the columns of `more` if `extra`."""
        count = gram.shape[-1] - 1
        used = np.flatnonzero(self.used[:-1] & ((np.arange(count) < count - self.extra) | extra))
        total = np.tensordot(weights, gram, 1)
        solution = np.zeros(count + 1)
        if len(used):
            solution[used] = -np.linalg.lstsq(total[np.ix_(used, used)], total[used, -1], rcond=1e-12)[0]
        solution[-1] = 1.0
        left = np.maximum(np.einsum("k,jkl,l->j", solution, gram, solution), FLOOR * gram[:, -1, -1]) + 1e-300
        return -solution[:-1] / self.size[:-1] * self.size[-1], left * self.size[-1] ** 2

    def fitted(
        self, extra: bool = False, weights: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coefficients, power left, and weights: those given, or in proportion to 1 over the power that is left."""
        gram = self.grams().sum(axis=0)
        chosen = 1.0 / np.maximum(gram[:, -1, -1], 1e-300) if weights is None else weights
        for _ in range(3 if weights is None else 0):
            chosen = self.size[-1] ** 2 / self.solved(gram, chosen, extra)[1]
        return *self.solved(gram, chosen, extra), chosen


def _friction(
    rows: Dataset, system: forcegp.mechanics.MechanicalSystem, dynamics: forcegp.mechanics.ConstrainedDynamics
) -> Float[Tensor, "rows nv k"]:
    """Joint forces of viscous and dry friction and constants in every joint, and of friction at every contact."""
    state, v = dynamics.state, dynamics.state.v
    slow = SLOW * v.square().mean(0).sqrt() + 1e-12
    forces = [
        torch.diag_embed(v),
        torch.diag_embed(torch.tanh(v / slow)),
        torch.eye(rows.nv).to(v).expand(len(v), -1, -1),
    ]
    multipliers = dynamics.multiplier_map().offset.abs()
    many = len(v) >= MANY_ROWS
    for index, contact in enumerate(system.contacts):
        J = state.kinematics.frame_jacobian(contact.frame, contact.point)[:, :3]
        velocity = (J @ v[..., None])[..., 0]
        speed = torch.linalg.vector_norm(velocity, dim=-1, keepdim=True)
        direction = velocity / (speed + SLOW * speed.square().mean().sqrt() + 1e-12)
        tangential = torch.stack([velocity, direction, direction * multipliers[:, [index]]], dim=-1)
        forces.append(J.mT @ tangential)
        if many:  # friction beside the stated point turns the link about the normal
            turning = state.kinematics.frame_jacobian(contact.frame, contact.point)[:, 3:]
            along = turning.mT @ dynamics.normals[:, index, :, None]
            forces.append(along * torch.cat([velocity, direction * multipliers[:, [index]]], dim=-1)[:, None])
    return torch.cat(forces, dim=-1)


def moved_points(
    rows: Dataset, system: forcegp.mechanics.MechanicalSystem
) -> tuple[list[forcegp.mechanics.MechanicalSystem], list[np.ndarray]]:
    """The system with each contact point moved along the surface, in both directions of the link's frame."""
    kinematics = system.robot.kinematics(torch.tensor(rows.q))
    others, tangents = [], []
    for index, contact in enumerate(system.contacts):
        normal = contact.surface.gradient(contact.position(kinematics))
        local = (kinematics.frame_pose(contact.frame)[:, :3, :3].mT @ normal[..., None])[..., 0].numpy()
        across = np.linalg.eigh(local.T @ local)[1][:, :2].T  # the directions that are least along the normal
        for direction in across:
            point = tuple(np.asarray(contact.point) + STEP * direction)
            contacts = list(system.contacts)
            contacts[index] = replace(contact, point=point)
            others.append(system.with_contacts(contacts))
        tangents.append(across)
    return others, tangents
