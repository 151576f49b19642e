"""Friction laws as numbers: at a point that slides on a surface, and in the joints. Loads numpy only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class ViscousFriction:
    """`F = -coefficient p'` (Stokes; coefficient in N/(m/s)), whatever the normal force is.

    As in Rath, Geist, Trimpe 2021 it acts on the whole velocity, of which almost nothing is normal to the surface.
    """

    load_dependent: ClassVar[bool] = False  # whether `force` is per newton of normal force
    coefficient: float

    def force(self, velocity: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Force on the sliding point [N] at its velocity [m/s]; never does positive work."""
        return -self.coefficient * velocity


@dataclass(frozen=True)
class DryFriction:
    """Coulomb's law with the Stribeck effect, per newton of normal force, smooth at rest.

    With the tangential velocity `p't` and its length s, `F = -mu(s) |N| p't / sqrt(s^2 + smoothing^2)` and
    `mu(s) = coulomb + (static - coulomb) exp(-(s / stribeck_velocity)^2)`: Tustin's exponential in the Gaussian form of
    Bo and Pavelescu (Armstrong-Helouvry, Dupont, Canudas de Wit 1994, section 2.1; Olsson et al. 1998, section 2.1).
    `static = coulomb` is Coulomb's law. The square root stands for the sign, so that there is no sticking: below
    `smoothing` the point creeps.

    coulomb, static: dimensionless; stribeck_velocity, smoothing: m/s.
    """

    load_dependent: ClassVar[bool] = True
    coulomb: float
    static: float
    stribeck_velocity: float
    smoothing: float

    def coefficient(self, speed: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """`|F| / |N|` at tangential speeds [m/s]."""
        level = self.coulomb + (self.static - self.coulomb) * np.exp(-((speed / self.stribeck_velocity) ** 2))
        return np.asarray(level * speed / np.sqrt(speed**2 + self.smoothing**2))

    def force(self, velocity: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """As of `ViscousFriction`, per newton of normal force; `normal` is a unit vector."""
        tangential = velocity - (normal @ velocity) * normal
        speed = np.sqrt(tangential @ tangential)
        level = self.coulomb + (self.static - self.coulomb) * np.exp(-((speed / self.stribeck_velocity) ** 2))
        return -level / np.sqrt(speed**2 + self.smoothing**2) * tangential


PointFriction = ViscousFriction | DryFriction


@dataclass(frozen=True, eq=False)
class JointStribeckFriction:
    """`Q_i = -[tanh(v_i / smoothing) (c_i + (s_i - c_i) exp(-(v_i / stribeck_velocity)^2)) + d_i v_i]` [Nm].

    Coulomb, Stribeck and viscous friction of every joint (Armstrong-Helouvry, Dupont, Canudas de Wit 1994, section 2.1;
    Olsson et al. 1998, section 2.1), tanh for the sign.

    coulomb c, static s: (nv,) [Nm]; viscous d: (nv,) [Nms/rad]; stribeck_velocity, smoothing: [rad/s].
    """

    coulomb: Float[np.ndarray, " nv"]
    static: Float[np.ndarray, " nv"]
    viscous: Float[np.ndarray, " nv"]
    stribeck_velocity: float
    smoothing: float

    def force(self, v: Float[np.ndarray, "*batch nv"]) -> Float[np.ndarray, "*batch nv"]:
        """Joint torques [Nm] at joint velocities [rad/s]; `force_i v_i <= 0`."""
        level = self.coulomb + (self.static - self.coulomb) * np.exp(-((v / self.stribeck_velocity) ** 2))
        return -(np.tanh(v / self.smoothing) * level + self.viscous * v)


@dataclass(frozen=True)
class RoughPatch:
    """A strip of the table, `lower < x < upper`, where friction is `factor` times as large; edges some mm wide.

    `1 + (factor - 1) / 2 [tanh((x - lower) / width) - tanh((x - upper) / width)]`; x and lengths in m.
    """

    lower: float
    upper: float
    factor: float
    width: float = 0.003

    def scale(self, x: float) -> float:
        """How many times as large friction is at x [m]."""
        inside = 0.5 * (np.tanh((x - self.lower) / self.width) - np.tanh((x - self.upper) / self.width))
        return float(1.0 + (self.factor - 1.0) * inside)
