"""Friction of a plant's joints: laws of `forcegp.forces` by name, and some that no model has.

A plant of other form than every model tells what a model's own form is worth, so some laws are here alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from forcegp.forces.columns import LazyState
from forcegp.forces.force import JointLaw, Law
from forcegp.forces.registry import parse_forces
from forcegp.forces.viscous import Viscous
from forcegp.robots import Robot
from forcegp.simulation.scenarios import OF_PLANTS, KukaSurfaceConfig

Numbers = Mapping[str, Any]
"""Coefficients by name, one number or one per joint; "velocity" stands for velocities that have no number here."""


def joint_laws(expression: str, robot: Robot, numbers: Numbers) -> tuple[Law, ...]:
    """The laws of this expression (`parse_forces`), with viscous friction, bound to the robot.

    Coefficients that it does not give have these numbers, or their defaults.
    """
    forces = parse_forces(expression)
    laws = forces if any(isinstance(force, Viscous) for force in forces) else (Viscous(), *forces)
    out = []
    for law in laws:
        assert isinstance(law, JointLaw), "`require_joint_friction` sees to it"
        found = {}
        for name, coefficient in law.coefficients.items():
            given = getattr(law, name)
            number = numbers.get(name, numbers["velocity"] if coefficient.unit == "velocity" else coefficient.default)
            found[name] = number if given is None else given
        out.append(law.with_values(found).bound_to(robot))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class LawsOfJoints:
    """What laws make of velocities, step by step."""

    robot: Robot
    laws: tuple[Law, ...]

    @classmethod
    def named(cls, expression: str, robot: Robot, numbers: Numbers) -> "LawsOfJoints":
        """`joint_laws`; none for "none"."""
        return cls(robot, () if expression == "none" else joint_laws(expression, robot, numbers))

    def __call__(
        self, v: Float[np.ndarray, "*batch nv"], u: np.ndarray | None = None
    ) -> Float[np.ndarray, "*batch nv"]:
        """Joint forces [Nm or N] with the sign that accelerates; u [Nm or N] is that of the actuators."""
        at = torch.tensor(v)
        state = LazyState(self.robot, torch.zeros_like(at), at, torch.zeros_like(at) if u is None else torch.tensor(u))
        return sum((law.force(state).numpy() for law in self.laws), np.zeros_like(v))

    def slope(self, v: Float[np.ndarray, " nv"], step: float = 1e-6) -> Float[np.ndarray, " nv"]:
        """-dQ/dv of every joint, where it is positive: how much of a velocity a step loses."""
        low, high = self(np.stack([v - step, v + step]))
        return np.maximum((low - high) / (2.0 * step), 0.0)


class JointFrictionLaw:
    """The friction that `KukaSurfaceConfig.joint_friction` names, of all joints of one episode; it may have a memory.

    Laws of `forcegp.forces`, and, with Coulomb's c, near rest s, viscous d, a smooth sign tanh(v / w) and torques
    resisting the motion:

    * exponential: (c + (s - c) exp(-|v| / v_s)) tanh + d v (Armstrong-Helouvry, Dupont, Canudas de Wit 1994, section
      2.1; Olsson et al. 1998, section 2.1).
    * asymmetric: c sign(v) + d v, c times `joint_asymmetry` backwards. A joint that dry friction can stop within a
      step stops: the sign is limited to v I / (c dt), with I the inertia that a torque at that joint alone moves.
    * load: (c + mu |u|) tanh + d v, where mu is one number while the joint is driven and another while it is driven
      back (`joint_load`).
    * lugre: sigma z + d v with bristles z' = v - sigma |v| z / g, g = c + (s - c) exp(-(v / v_s)^2) and sigma =
      c / `joint_presliding` (Canudas de Wit, Olsson, Astrom, Lischinsky 1995), exact for a velocity constant in a step.
    * drift: Coulomb's, of which a share is lost as gears warm up: 1 - share (1 - exp(-t / T)) (`joint_drift`).
    """

    def __init__(self, config: KukaSurfaceConfig, robot: Robot) -> None:
        self.config = config
        names = ("joint_coulomb", "joint_static", "joint_viscous")
        self.coulomb, self.static, self.viscous = (np.array(getattr(config, name)) for name in names)
        self.bristles = np.zeros_like(self.coulomb)
        self.laws: LawsOfJoints | None = None
        if config.joint_friction not in OF_PLANTS:
            numbers = {"damping": self.viscous, "level": self.coulomb, "breakaway": self.static - self.coulomb}
            numbers |= {"velocity_scale": config.joint_smoothing, "velocity": config.joint_breakaway_velocity}
            self.laws = LawsOfJoints.named(config.joint_friction, robot, numbers)

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
                share = np.where(u * v > 0.0, *config.joint_load)
                return -(np.tanh(v / config.joint_smoothing) * share * np.abs(u) + self.curve(v))
            case "drift":
                share, seconds = config.joint_drift
                level = self.coulomb * (1.0 + share * np.expm1(-time / seconds))
                return -(np.tanh(v / config.joint_smoothing) * level + self.viscous * v)
            case "lugre":
                return self._lugre(v)
        return -self.curve(v)

    def _lugre(self, v: np.ndarray) -> np.ndarray:
        dt, config = self.config.time_step, self.config
        stiffness = self.coulomb / config.joint_presliding
        falling = np.exp(-((v / config.joint_breakaway_velocity) ** 2))
        force = stiffness * self.bristles + self.viscous * v
        rate = stiffness * np.abs(v) / np.maximum(self.coulomb + (self.static - self.coulomb) * falling, 1e-12)
        steps = np.where(rate > 1e-12, -np.expm1(-rate * dt) / np.maximum(rate, 1e-12), dt)
        self.bristles = self.bristles + steps * (v - rate * self.bristles)
        return -force

    def _either_way(self, v: np.ndarray) -> np.ndarray:
        return self.coulomb * np.where(v < 0.0, self.config.joint_asymmetry, 1.0)
