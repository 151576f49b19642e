"""Friction of the joints, step by step: laws of the velocity alone, and laws with load, memory and temperature."""

import numpy as np
from jaxtyping import Float

from forcegp.simulation.scenarios import KukaSurfaceConfig

OF_VELOCITY = ("coulomb", "stribeck", "exponential", "asymmetric")
"""Laws that are a curve over the velocity."""


class JointFrictionLaw:
    """The friction that `KukaSurfaceConfig.joint_friction` names, of all joints of one episode; it may have a memory.

    With Coulomb's c, near rest s, viscous d, a smooth sign tanh(v / w) and torques resisting the motion:

    * coulomb: c tanh + d v. stribeck: (c + (s - c) exp(-(v / v_s)^2)) tanh + d v, Tustin's exponential in the Gaussian
      form of Bo and Pavelescu; exponential: exp(-|v| / v_s) instead (Armstrong-Helouvry, Dupont, Canudas de Wit 1994,
      section 2.1; Olsson et al. 1998, section 2.1).
    * asymmetric: c sign(v) + d v, c times `joint_asymmetry` backwards. A joint that dry friction can stop within a
      step stops: the sign is limited to v I / (c dt), with I the inertia that a torque at that joint alone moves.
    * load: (c + mu |u|) tanh + d v, where mu is one number while the joint is driven and another while it is driven
      back (`joint_load`).
    * lugre: sigma z + d v with bristles z' = v - sigma |v| z / g, g = c + (s - c) exp(-(v / v_s)^2) and sigma =
      c / `joint_presliding` (Canudas de Wit, Olsson, Astrom, Lischinsky 1995), exact for a velocity constant in a step.
    * drift: coulomb, of which a share is lost as gears warm up: 1 - share (1 - exp(-t / T)) (`joint_drift`).
    """

    def __init__(self, config: KukaSurfaceConfig) -> None:
        self.config = config
        names = ("joint_coulomb", "joint_static", "joint_viscous")
        self.coulomb, self.static, self.viscous = (np.array(getattr(config, name)) for name in names)
        self.bristles = np.zeros_like(self.coulomb)

    def curve(self, v: Float[np.ndarray, "*batch nv"]) -> Float[np.ndarray, "*batch nv"]:
        """Resisting torques [Nm] at velocities [rad/s], for laws `OF_VELOCITY`; else of a cold, unloaded joint."""
        config = self.config
        if config.joint_friction == "asymmetric":
            return np.sign(v) * self._either_way(v) + self.viscous * v
        return np.tanh(v / config.joint_smoothing) * self._level(v) + self.viscous * v

    def step(
        self, v: Float[np.ndarray, " nv"], u: Float[np.ndarray, " nv"], mass: Float[np.ndarray, "nv nv"], time: float
    ) -> Float[np.ndarray, " nv"]:
        """Torques of friction [Nm] during the next time step, from velocities [rad/s], applied torques and inertias."""
        config, dt = self.config, self.config.time_step
        smooth = np.tanh(v / config.joint_smoothing)
        if config.joint_friction == "asymmetric":
            level = self._either_way(v)
            stopping = v / (np.linalg.inv(mass).diagonal() * dt)
            return -(np.clip(stopping, -level, level) + self.viscous * v)
        if config.joint_friction == "load":
            driven, back = config.joint_load
            return -(smooth * np.where(u * v > 0.0, driven, back) * np.abs(u) + self.curve(v))
        if config.joint_friction == "lugre":
            stiffness = self.coulomb / config.joint_presliding
            force = stiffness * self.bristles + self.viscous * v
            rate = stiffness * np.abs(v) / np.maximum(self._level(v), 1e-12)
            steps = np.where(rate > 1e-12, -np.expm1(-rate * dt) / np.maximum(rate, 1e-12), dt)
            self.bristles = self.bristles + steps * (v - rate * self.bristles)
            return -force
        if config.joint_friction == "drift":
            share, seconds = config.joint_drift
            return -(smooth * self.coulomb * (1.0 + share * np.expm1(-time / seconds)) + self.viscous * v)
        return -self.curve(v)

    def _level(self, v: np.ndarray) -> np.ndarray:
        kind, ratio = self.config.joint_friction, np.abs(v) / self.config.joint_stribeck_velocity
        if kind not in ("stribeck", "exponential", "lugre"):
            return self.coulomb
        return self.coulomb + (self.static - self.coulomb) * np.exp(-ratio if kind == "exponential" else -(ratio**2))

    def _either_way(self, v: np.ndarray) -> np.ndarray:
        return self.coulomb * np.where(v < 0.0, self.config.joint_asymmetry, 1.0)
