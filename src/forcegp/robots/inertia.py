"""Rotations, and inertial parameters of a body: mass, centre of mass, inertia <-> pseudo-inertia P (4, 4).

P = [[Sigma + m c c^T, m c], [m c^T, m]], Sigma = tr(I)/2 1 - I (Wensing, Kim & Slotine, RA-L 2018); a body of mass m in
kg, centre c in m and inertia I about it in kg m^2 has P if and only if that is positive semi-definite.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

Array = np.ndarray


def rotation_from_rpy(rpy: Sequence[float] | Array) -> Array:
    """Rotation ``Rz(yaw) Ry(pitch) Rx(roll)`` in rad: URDF's fixed-axis convention, shape (3, 3)."""
    return Rotation.from_euler("xyz", rpy).as_matrix()


def rpy_from_rotation(rotation: Array) -> Array:
    """Angles roll, pitch, yaw (3,) in rad of :func:`rotation_from_rpy`, exact also where pitch is a right angle."""
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    rest = rotation_from_rpy((0.0, 0.0, -yaw)) @ rotation  # Ry(pitch) Rx(roll)
    return np.array([math.atan2(-rest[1, 2], rest[1, 1]), math.atan2(-rest[2, 0], rest[0, 0]), yaw])


def rotation_about(axis: Sequence[float] | Array, angle: float) -> Array:
    """Rotation by ``angle`` rad about a unit ``axis``, shape (3, 3)."""
    return Rotation.from_rotvec(angle * np.asarray(axis)).as_matrix()


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


# relative to the trace of the inertia: what turning an ideal rod or plate in float64 costs, with a wide margin
ROUNDING = 1e-10
# m^2; the square of a hundred millionth of a metre: a point, whatever the digits of a file say
SMALLEST = 1e-16
# relative second moment below which is what rounding left of zero
SINGULAR = 1e-12

# standard parameters m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz -> pseudo-inertia (4, 4), row by row
_STANDARD = np.zeros((16, 10))
_STANDARD[15, 0] = 1.0
_STANDARD[[3, 12, 7, 13, 11, 14], [1, 1, 2, 2, 3, 3]] = 1.0
_STANDARD[np.ix_([0, 5, 10], [4, 6, 9])] = 0.5 - np.eye(3)
_STANDARD[[1, 4, 2, 8, 6, 9], [5, 5, 7, 7, 8, 8]] = -1.0


def standard_basis(device: torch.device | None = None) -> Float[Tensor, "16 10"]:
    """From standard parameters m, m c, I about the *origin* (10,) to the pseudo-inertia by rows (Pinocchio's order)."""
    return torch.as_tensor(_STANDARD, device=device)


def pseudo_inertia_of_standard(parameters: Float[Tensor, "*batch 10"]) -> Float[Tensor, "*batch 4 4"]:
    """Pseudo-inertia of standard parameters (see :func:`standard_basis`); no body need have them."""
    return (parameters @ standard_basis(parameters.device).mT).unflatten(-1, (4, 4))


def standard_of_pseudo_inertia(pseudo: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 10"]:
    """Standard parameters of a symmetric pseudo-inertia: the inverse of :func:`pseudo_inertia_of_standard`."""
    return pseudo.flatten(-2) @ torch.linalg.pinv(standard_basis(pseudo.device)).mT


def pseudo_inertia(mass: float, center_of_mass: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Pseudo-inertia (4, 4) of a mass (kg), centre of mass (m) and inertia about it (kg m^2), NumPy."""
    homogeneous = np.append(center_of_mass, 1.0)
    out = mass * np.outer(homogeneous, homogeneous)
    out[:3, :3] += 0.5 * np.trace(inertia) * np.eye(3) - inertia
    return out


def physical_of_pseudo_inertia(pseudo: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """The inverse of :func:`pseudo_inertia`."""
    mass, center = float(pseudo[3, 3]), pseudo[:3, 3] / pseudo[3, 3]
    second = pseudo[:3, :3] - mass * np.outer(center, center)
    return mass, center, np.trace(second) * np.eye(3) - second


def physical_objection(mass: float, center_of_mass: np.ndarray, inertia: np.ndarray) -> str | None:
    """What makes these parameters impossible beyond rounding, or None; ideal rods, plates and points are possible."""
    if not (np.isfinite(mass) and np.isfinite(center_of_mass).all() and np.isfinite(inertia).all()):
        return "it holds values that are not finite"
    if mass < 0.0:
        return f"its mass {mass:g} kg is negative"
    if mass == 0.0:
        return "its mass is zero but its inertia is not" if inertia.any() else None
    moments = np.linalg.eigvalsh(inertia)
    listed = ", ".join(f"{moment:.10g}" for moment in moments)
    slack = ROUNDING * abs(moments).sum() + SMALLEST * mass
    if moments[0] < -slack:
        return f"its inertia is not positive definite (principal moments {listed} kg m^2)"
    if moments[0] + moments[1] < moments[2] - slack:
        rule = "the triangle inequality (the two smaller must add up to the largest at least)"
        return f"its principal moments {listed} kg m^2 break {rule}"
    return None


def turns_with_inertia(pseudo: np.ndarray) -> bool:
    """Whether a body (pseudo-inertia (4, 4)) that moves freely resists every turn."""
    first, mass = pseudo[:3, 3], pseudo[3, 3]
    least = np.linalg.eigvalsh(pseudo[:3, :3] - np.outer(first, first) / mass)[1]
    return bool(least > SINGULAR * pseudo.diagonal()[:3].sum())
