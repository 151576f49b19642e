"""What friction leaves of the accelerations under given contacts, by linear least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

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
    """Accelerations that friction and some more columns leave of `a` under a model's contacts, joint by joint.

    `friction` (rows, nv, k) are joint forces of the friction that may be there (default: of joints and contacts),
    `more` the same model with something moved by STEP, whose effect is one more column each.
    """

    def __init__(
        self,
        rows: Dataset,
        model: forcegp.Model,
        friction: Float[Tensor, "rows nv k"] | None = None,
        more: Sequence[forcegp.Model] = (),
    ) -> None:
        q, v, u, a = tensors(rows)
        dynamics = model.dynamics(q, v, u)
        given = dynamics.acceleration_map().offset
        self.friction = _friction(rows, model, dynamics) if friction is None else friction
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
    rows: Dataset, model: forcegp.Model, dynamics: forcegp.mechanics.ConstrainedDynamics
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
    for index, contact in enumerate(model.contacts):
        J, turning = state.kinematics.frame_jacobian(contact.frame, contact.point).split(3, dim=1)
        velocity = (J @ v[..., None])[..., 0]
        speed = torch.linalg.vector_norm(velocity, dim=-1, keepdim=True)
        direction = velocity / (speed + SLOW * speed.square().mean().sqrt() + 1e-12)
        tangential = torch.stack([velocity, direction, direction * multipliers[:, [index]]], dim=-1)
        forces.append(J.mT @ tangential)
        if many:  # friction beside the stated point turns the link about the normal
            along = turning.mT @ dynamics.normals[:, index, :, None]
            forces.append(along * torch.cat([velocity, direction * multipliers[:, [index]]], dim=-1)[:, None])
    return torch.cat(forces, dim=-1)


def moved_points(rows: Dataset, model: forcegp.Model) -> tuple[list[forcegp.Model], list[np.ndarray]]:
    """The model with each contact point moved along the surface, in both directions of the link's frame."""
    kinematics = model.robot.kinematics(torch.tensor(rows.q))
    others, tangents = [], []
    for index, contact in enumerate(model.contacts):
        normal = contact.surface.gradient(contact.position(kinematics))
        local = (kinematics.frame_pose(contact.frame)[:, :3, :3].mT @ normal[..., None])[..., 0].numpy()
        across = np.linalg.eigh(local.T @ local)[1][:, :2].T  # the directions that are least along the normal
        for direction in across:
            point = tuple(np.asarray(contact.point) + STEP * direction)
            contacts = list(model.contacts)
            contacts[index] = replace(contact, point=point)
            others.append(model.with_contacts(contacts))
        tangents.append(across)
    return others, tangents


FEWEST_ROWS = 20
NEEDED = 2.0
"""Logarithm of what remains of accelerations without the contact over what remains with it, over all joints."""

STAYS = 3e-3
"""Mean square velocity along a direction, relative to what joints that move independently would give."""

ARM = 0.3
"""Size in m of a link: of several points that stay on a surface, one not farther from its frame than that is likely."""


def missing_contact(rows: Dataset, model: forcegp.Model) -> tuple[float, forcegp.mechanics.Contact] | None:
    """A point of a last link that stays on a plane or sphere, with a force along the normal that accelerations need.

    And the logarithm of what remains of the accelerations without it over what remains with it, over all joints.
    """
    if len(rows) < FEWEST_ROWS or rows.nv < 2:
        return None
    robot = model.robot
    parents = set(robot.layout.parents)
    best: tuple[float, forcegp.mechanics.Contact] | None = None
    for body, joint in enumerate(robot.layout.bodies):
        if body in parents:
            continue
        for contact in _surfaces(rows, robot, joint.child):
            others, _ = moved_points(rows, model.with_contacts([contact]))
            with_it = Residual(rows, model.with_contacts([contact]), more=others)
            _, left, weights = with_it.fitted(extra=True)  # the motion may show the surface, and not the point
            free = Residual(rows, model, friction=with_it.friction).fitted(weights=weights)[1]
            own = Residual(rows, model, friction=with_it.friction).fitted()[1]
            gain = float(np.log(np.minimum(free, own) / left).sum())
            if gain > NEEDED and (best is None or gain > best[0]):
                best = gain, contact
    return best


def _surfaces(rows: Dataset, robot: Any, frame: str) -> list[forcegp.mechanics.Contact]:
    """Contacts of an unknown point p of `frame` with a plane or sphere, along which the frame moves.

    A plane with the normal n holds n (v_o + w x R p) = 0, linear in n and n p^T; a sphere adds s (x . dx/dt) with x the
    position of the point. The smallest eigenvalues, relative to joints that move independently, are constraints.
    """
    q, v = torch.tensor(rows.q), torch.tensor(rows.v)
    kinematics = robot.kinematics(q, v)
    J = kinematics.frame_jacobian(frame).numpy()
    pose = kinematics.frame_pose(frame).numpy()
    R, origin = pose[:, :3, :3], pose[:, :3, 3]
    turned = [np.cross(J[:, 3:], R[:, None, :, k], axisa=1, axisb=2).transpose(0, 2, 1) for k in range(3)]  # w x R e_k
    plane = [J[:, i] for i in range(3)] + [turned[k][:, i] for i in range(3) for k in range(3)]
    round_ = [np.einsum("ri,rij->rj", origin, J[:, :3])]
    round_ += [
        np.einsum("ri,rij->rj", origin, turned[k]) + np.einsum("ri,rij->rj", R[:, :, k], J[:, :3]) for k in range(3)
    ]
    spread = np.sqrt(np.square(rows.v).mean(axis=0))
    found = []
    for columns in (plane, plane + round_):
        z = np.stack(columns, axis=1)  # (rows, k, nv)
        scale = 1.0 / np.maximum(np.sqrt(np.square(z * spread).mean(axis=(0, 2))), 1e-12)
        z = z * scale[:, None]
        free = np.einsum("rkj,rlj,j->kl", z, z, spread**2) / len(rows)
        moved = np.einsum("rkj,rj->rk", z, rows.v)
        held = moved.T @ moved / len(rows)
        powers, directions = np.linalg.eigh(free)
        kept = powers > 1e-6 * powers[-1]
        if len(rows) < 3 * kept.sum():
            continue
        basis = directions[:, kept] / np.sqrt(powers[kept])
        ratios, vectors = np.linalg.eigh(basis.T @ held @ basis)
        small = ratios < STAYS
        if not small.any():
            continue
        space = scale[:, None] * (basis @ vectors[:, small])  # constraints, in the columns' own units
        size = np.where(np.arange(len(space)) < 3, 1.0, ARM)
        shape = np.linalg.qr(space / size[:, None])[0]
        nearest = shape @ np.linalg.svd(shape[:3], full_matrices=False)[2][0]  # of several: near the frame's origin
        found.append(_surface(size * nearest, frame, R, origin))
    return [contact for contact in found if contact is not None]


def _surface(
    z: Float[np.ndarray, " k"], frame: str, R: Float[np.ndarray, "rows 3 3"], origin: Float[np.ndarray, "rows 3"]
) -> forcegp.mechanics.Contact | None:
    """The contact of one constraint."""
    normal, product = z[:3], z[3:12].reshape(3, 3)
    size = float(np.linalg.norm(normal))
    if not size > 0.0:
        return None
    point = product.T @ normal / size**2
    position = origin + R @ point
    if len(z) > 12 and abs(z[12]) * np.ptp(position, axis=0).max() > 1e-2 * size:
        center = -normal / z[12]
        radius = float(np.linalg.norm(position - center, axis=1).mean())
        return forcegp.mechanics.Contact(frame, tuple(point), forcegp.mechanics.Sphere(tuple(center), radius))
    normal = normal / size
    return forcegp.mechanics.Contact(
        frame, tuple(point), forcegp.mechanics.Plane(tuple(normal), float((position @ normal).mean()))
    )
