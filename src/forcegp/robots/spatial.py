"""Rotations and homogeneous transforms that describe a robot at rest (NumPy, computed once per robot)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

Array = np.ndarray


def skew(vector: Sequence[float] | Array) -> Array:
    """Cross-product matrix ``[w]x`` with ``[w]x p = w x p``, shape (3, 3)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_from_rpy(rpy: Sequence[float] | Array) -> Array:
    """Rotation ``Rz(yaw) Ry(pitch) Rx(roll)`` in rad: URDF's fixed-axis convention, shape (3, 3)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_about(axis: Sequence[float] | Array, angle: float) -> Array:
    """Rotation by ``angle`` rad about a unit ``axis`` (Rodrigues' formula), shape (3, 3)."""
    cross = skew(axis)
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)


def rotation_of_z_onto(axis: Sequence[float] | Array) -> Array:
    """A rotation whose third column is the unit vector ``axis`` (the identity when ``axis`` is z), shape (3, 3)."""
    z = np.asarray(axis, dtype=np.float64)
    # the coordinate direction most perpendicular to the axis keeps the construction well conditioned
    x = np.eye(3)[0] if abs(z[0]) <= max(abs(z[1]), abs(z[2])) else np.eye(3)[1]
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def transform(rotation: Array, translation: Sequence[float] | Array) -> Array:
    """Homogeneous transform ``[[R, p], [0, 1]]``, shape (4, 4), lengths in m."""
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = translation
    return out


def inverse(pose: Array) -> Array:
    """Inverse of a homogeneous transform, shape (4, 4)."""
    rotation = pose[:3, :3].T
    return transform(rotation, -rotation @ pose[:3, 3])
