"""Task-space inverse dynamics: the tool point follows a path, the tool keeps its orientation, the arm its posture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class TaskSpaceController:
    """Resolved-acceleration control (Siciliano et al., Robotics, section 8.6.2) with a null-space posture.

    With `e` the error of the tool (translation; rotation vector), the commanded joint acceleration is
    `J^+ (x_ref'' + 2 zeta omega e' + omega^2 e - Jdot v) + (I - J^+ J) S (K (q_0 - q) - D v)`; `S` selects joints.
    It compensates inertia, gravity and joint damping, but neither the surface nor its friction.

    omega [rad/s], zeta: error dynamics; orientation: (4,) quaternion (x, y, z, w) of the tool frame that is held;
    posture: (nv,) `q_0` [rad]; selected: (nv,) diagonal of `S`; stiffness `K` [1/s^2]; damping `D` [1/s].
    """

    omega: float
    zeta: float
    orientation: Float[np.ndarray, "4"]
    posture: Float[np.ndarray, " nv"]
    selected: Float[np.ndarray, " nv"]
    stiffness: float
    damping: float

    def joint_acceleration(
        self,
        q: Float[np.ndarray, " nv"],
        v: Float[np.ndarray, " nv"],
        jacobian: Float[np.ndarray, "6 nv"],
        bias_acceleration: Float[np.ndarray, "6"],
        position: Float[np.ndarray, "3"],
        quaternion: Float[np.ndarray, "4"],
        reference: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]],
    ) -> Float[np.ndarray, " nv"]:
        """Commanded joint acceleration [rad/s^2]; `reference` is the aimed position, velocity and acceleration."""
        aim, aim_velocity, aim_acceleration = reference
        velocity = jacobian @ v
        task = np.empty(6)
        gain = 2.0 * self.zeta * self.omega
        task[:3] = aim_acceleration + gain * (aim_velocity - velocity[:3]) + self.omega**2 * (aim - position)
        task[3:] = -gain * velocity[3:] + self.omega**2 * rotation_vector(self.orientation, quaternion)
        posture = self.selected * (self.stiffness * (self.posture - q) - self.damping * v)
        # J^+ (task - Jdot v) + (I - J^+ J) posture, with J^+ = J^T (J J^T)^-1
        residual = task - bias_acceleration - jacobian @ posture
        return posture + jacobian.T @ np.linalg.solve(jacobian @ jacobian.T, residual)


def rotation_vector(aim: Float[np.ndarray, "4"], present: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3"]:
    """World-frame rotation vector [rad] that turns `present` into `aim` (quaternions x, y, z, w) by the shorter way.

    `q` and `-q` are the same orientation; without choosing the sign the tool would turn the long way round.
    """
    x, y, z, w = aim.tolist()
    a, b, c, d = (present * (-1.0, -1.0, -1.0, 1.0)).tolist()  # the conjugate
    real = w * d - x * a - y * b - z * c
    imaginary = np.array([w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a, w * c + x * b - y * a + z * d])
    if real < 0:
        real, imaginary = -real, -imaginary
    sine = math.sqrt(float(imaginary @ imaginary))
    if sine < 1e-12:
        return 2.0 * imaginary
    return 2.0 * math.atan2(sine, real) / sine * imaginary
