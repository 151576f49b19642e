"""`ur5-free` and `double-pendulum`: arms that touch nothing; and friction of joints by name, of all plants."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.forces import Actuation, RigidBodies
from forcegp.forces.force import Law
from forcegp.forces.joint_law import JointLaw
from forcegp.forces.joint_laws import LazyState, Viscous
from forcegp.forces.registry import parse_forces
from forcegp.model import Model
from forcegp.progress import tell
from forcegp.robots import Robot
from forcegp.simulation.scenarios import FreeArmConfig
from forcegp.simulation.trajectory import RATE, compiled_plant, recorded

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


FINE = 4  # steps between two rows
STIFFNESS = 100.0  # of the controller in 1/s^2, critically damped
COULOMB, BREAKAWAY, VISCOUS = 0.02, 0.01, 0.01  # of a joint's largest torque; viscous per rad/s
FALLING, SMOOTH, SIZE, RATES = 0.1, 0.02, 0.35, (0.8, 3.5)  # [rad/s]; of the sines that joints follow [rad, rad/s]
ARMS = {  # URDF, posture, and inertia of geared rotors in parts of the largest torque [kg m^2 / Nm]
    "ur5-free": ("ur5.urdf", (0.0, -1.2, 1.4, -0.8, -1.5, 0.0), 0.01),
    "double-pendulum": ("double_pendulum.urdf", (0.4, -0.5), 0.0),
}


def simulate_free_arm(config: FreeArmConfig) -> Dataset:
    """Rows k: q, v, the torque u until row k + 1, and a at the row, so that M a + h = u + Q_U with the true Q_U."""
    file, middle, rotors = ARMS[config.arm]
    robot = Robot.from_urdf(Path(__file__).parent / file)
    most = np.array([joint.effort_limit for joint in robot.joints])
    robot = robot.with_armature(rotors * most)
    plant = compiled_plant(robot)
    numbers = {"damping": VISCOUS * most, "level": COULOMB * most, "breakaway": BREAKAWAY * most}
    friction = LawsOfJoints.named(
        str(config.joint_friction), robot, {**numbers, "velocity_scale": SMOOTH, "velocity": FALLING}
    )

    def acceleration(q: np.ndarray, v: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        """At the row for dt = 0, else of a step that is implicit in friction, to first order: it may be stiff."""
        M, h = (x.numpy() for x in plant.mass_matrix_and_bias(torch.from_numpy(q), torch.from_numpy(v)))
        slope = dt * friction.slope(v) if dt else np.zeros_like(v)
        return np.linalg.solve(M + np.diag(slope), u + friction(v, u) - h)

    steps, rows = max(2, round(config.seconds * RATE)), []
    for episode in range(config.episodes):
        rng = np.random.default_rng([config.seed, episode])
        amplitude, w = SIZE * rng.uniform(0.5, 1.0, (2, robot.nv)), rng.uniform(*RATES, (2, robot.nv))
        home = middle + rng.uniform(-SIZE, SIZE, robot.nv)
        q, v = home, np.zeros(robot.nv)
        for k in range(steps):
            t = k / RATE
            ramp, slope = 1.0 - np.exp(-(t**2)), 2.0 * t * np.exp(-(t**2))  # from rest
            x, dx = (amplitude * np.sin(w * t)).sum(0), (amplitude * w * np.cos(w * t)).sum(0)
            wanted = STIFFNESS * (home + ramp * x - q) + 2.0 * STIFFNESS**0.5 * (slope * x + ramp * dx - v)
            M, g = plant.mass_matrix(torch.from_numpy(q)), plant.gravity_forces(torch.from_numpy(q))
            u = np.clip(M.numpy() @ wanted + g.numpy(), -most, most)
            rows.append((q, v, u, acceleration(q, v, u, 0.0), friction(v, u)))
            for _ in range(FINE):
                v = v + acceleration(q, v, u, 1.0 / (RATE * FINE)) / (RATE * FINE)
                q = q + v / (RATE * FINE)
            if k % RATE == 0:
                tell(episode * steps + k, config.episodes * steps)
    q, v, u, a, Q_U = map(np.array, zip(*rows, strict=True))
    model = Model(robot, forces=(Actuation(), RigidBodies()))
    truth = {"Q_U": Q_U} | ({"Q_U.joint-friction": Q_U} if friction.laws else {})
    return recorded(config.arm, config, model, {"q": q, "v": v, "u": u, "a": a}, truth)
