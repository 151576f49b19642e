"""Plants whose joints have friction of another form than every model: what is a model's own form worth?"""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from forcegp.robots import Robot
from forcegp.simulation import KukaSurfaceConfig
from forcegp.simulation.kuka_surface import joint_friction_of

OF_PLANTS = ("exponential", "asymmetric", "load", "lugre", "drift")  # joint friction that no model has
ASYMMETRY = 0.7  # Coulomb friction backwards over that forwards
LOAD = 0.04, 0.015  # per torque of a joint that drives, that is driven back
PRESLIDING = 0.01  # rad that a joint gives before it slides
DRIFT = 0.3, 60.0  # of Coulomb friction lost as gears warm up; in s


class JointFrictionLaw:
    """The friction that `KukaSurfaceConfig.joint_friction` names, of all joints of one episode; it may have a memory.

    Laws of `forcegp.forces`, and, with Coulomb's c, near rest s, viscous d, a smooth sign tanh(v / w) and torques
    resisting the motion:

    * exponential: (c + (s - c) exp(-|v| / v_s)) tanh + d v (Armstrong-Helouvry, Dupont, Canudas de Wit 1994, section
      2.1; Olsson et al. 1998, section 2.1).
    * asymmetric: c sign(v) + d v, c times `ASYMMETRY` backwards. A joint that dry friction can stop within a
      step stops: the sign is limited to v I / (c dt), with I the inertia that a torque at that joint alone moves.
    * load: (c + mu |u|) tanh + d v, where mu is one number while the joint is driven and another while it is driven
      back (`LOAD`).
    * lugre: sigma z + d v with bristles z' = v - sigma |v| z / g, g = c + (s - c) exp(-(v / v_s)^2) and sigma =
      c / `PRESLIDING` (Canudas de Wit, Olsson, Astrom, Lischinsky 1995), exact for a velocity constant in a step.
    * drift: Coulomb's, of which a share is lost as gears warm up: 1 - share (1 - exp(-t / T)) (`DRIFT`).
    """

    def __init__(self, config: KukaSurfaceConfig, robot: Robot) -> None:
        self.config = config
        names = ("joint_coulomb", "joint_static", "joint_viscous")
        self.coulomb, self.static, self.viscous = (np.array(getattr(config, name)) for name in names)
        self.bristles = np.zeros_like(self.coulomb)
        self.laws = None if config.joint_friction in OF_PLANTS else joint_friction_of(config, robot)

    @property
    def of_velocity(self) -> bool:
        """Whether it is a curve over the velocity."""
        if self.laws is not None:
            return not any(law.under_load for law in self.laws.laws)
        return self.config.joint_friction in ("exponential", "asymmetric")

    def curve(self, v: Float[np.ndarray, "*batch nv"]) -> Float[np.ndarray, "*batch nv"]:
        """Resisting torques [Nm] at velocities [rad/s], of a cold joint without load."""
        if self.laws is not None:
            return -self.laws(np.asarray(v))
        config = self.config
        if config.joint_friction == "asymmetric":
            return np.sign(v) * self._either_way(v) + self.viscous * v
        falling = (
            np.exp(-np.abs(v) / config.joint_breakaway_velocity) if config.joint_friction == "exponential" else 0.0
        )
        level = self.coulomb + (self.static - self.coulomb) * falling
        return np.tanh(v / config.joint_smoothing) * level + self.viscous * v

    def step(
        self, v: Float[np.ndarray, " nv"], u: Float[np.ndarray, " nv"], mass: Float[np.ndarray, "nv nv"], time: float
    ) -> Float[np.ndarray, " nv"]:
        """Torques of friction [Nm] during the next time step, from velocities [rad/s], applied torques and inertias."""
        if self.laws is not None:
            return self.laws(v, u)
        config = self.config
        match config.joint_friction:
            case "asymmetric":
                level = self._either_way(v)
                stopping = v / (np.linalg.inv(mass).diagonal() * config.time_step)
                return -(np.clip(stopping, -level, level) + self.viscous * v)
            case "load":
                share = np.where(u * v > 0.0, *LOAD)
                return -(np.tanh(v / config.joint_smoothing) * share * np.abs(u) + self.curve(v))
            case "drift":
                share, seconds = DRIFT
                level = self.coulomb * (1.0 + share * np.expm1(-time / seconds))
                return -(np.tanh(v / config.joint_smoothing) * level + self.viscous * v)
            case "lugre":
                return self._lugre(v)
        return -self.curve(v)

    def _lugre(self, v: np.ndarray) -> np.ndarray:
        dt, config = self.config.time_step, self.config
        stiffness = self.coulomb / PRESLIDING
        falling = np.exp(-((v / config.joint_breakaway_velocity) ** 2))
        force = stiffness * self.bristles + self.viscous * v
        rate = stiffness * np.abs(v) / np.maximum(self.coulomb + (self.static - self.coulomb) * falling, 1e-12)
        steps = np.where(rate > 1e-12, -np.expm1(-rate * dt) / np.maximum(rate, 1e-12), dt)
        self.bristles = self.bristles + steps * (v - rate * self.bristles)
        return -force

    def _either_way(self, v: np.ndarray) -> np.ndarray:
        return self.coulomb * np.where(v < 0.0, ASYMMETRY, 1.0)


class PlantConfig(KukaSurfaceConfig):
    """A config whose `joint_friction` may be one of `OF_PLANTS`."""

    own_laws: ClassVar = dict.fromkeys(OF_PLANTS, lambda config, robot: JointFrictionLaw(config, robot).step)
