"""A contact that nobody stated: a surface along which a link moves, and a force that keeps it there."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float

import forcegp.mechanics
from forcegp.data.contact_residual import Residual, moved_points
from forcegp.data.dataset import Dataset

FEWEST_ROWS = 20
NEEDED = 2.0
"""Logarithm of what remains of accelerations without the contact over what remains with it, over all joints."""

STAYS = 3e-3
"""Mean square velocity along a direction, relative to what joints that move independently would give."""

ARM = 0.3
"""Size in m of a link: of several points that stay on a surface, one not farther from its frame than that is likely."""


def missing_contact(
    rows: Dataset, system: forcegp.mechanics.MechanicalSystem
) -> tuple[float, forcegp.mechanics.Contact] | None:
    """A point of a last link that stays on a plane or sphere, with a force along the normal that accelerations need.

    And the logarithm of what remains of the accelerations without it over what remains with it, over all joints.
    """
    if len(rows) < FEWEST_ROWS or rows.nv < 2:
        return None
    robot = system.robot
    parents = set(robot.layout.parents)
    best: tuple[float, forcegp.mechanics.Contact] | None = None
    for body in range(rows.nv):
        if body in parents:
            continue
        for contact in _surfaces(rows, robot, robot.joints[body].child):
            others, _ = moved_points(rows, system.with_contacts([contact]))
            with_it = Residual(rows, system.with_contacts([contact]), more=others)
            _, left, weights = with_it.fitted(extra=True)  # the motion may show the surface, and not the point
            free = Residual(rows, system, friction=with_it.friction).fitted(weights=weights)[1]
            own = Residual(rows, system, friction=with_it.friction).fitted()[1]
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
        z = z / np.maximum(np.sqrt(np.square(z * spread).mean(axis=(0, 2))), 1e-12)[:, None]
        scale = 1.0 / np.maximum(np.sqrt(np.square(np.stack(columns, axis=1) * spread).mean(axis=(0, 2))), 1e-12)
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
