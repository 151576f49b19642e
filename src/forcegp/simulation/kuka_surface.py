"""The `kuka-surface` scenario: an iiwa slides its tool on a surface with friction (after Rath, Geist, Trimpe 2021)."""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.errors import RobotModelError, SimulationError, required_extra
from forcegp.forces import Actuation, RigidBodies
from forcegp.forces.registry import force_class
from forcegp.mechanics import Baumgarte, Contact, Surface
from forcegp.model import Model
from forcegp.progress import part, tell
from forcegp.robots import Robot
from forcegp.robots.structure import RigidBodyDynamics
from forcegp.robots.urdf import numbers
from forcegp.robots.urdf_file import inertial_element
from forcegp.simulation import trajectory
from forcegp.simulation.scenarios import KukaSurfaceConfig
from forcegp.simulation.trajectory import Friction, laws_of_joints

TOOL_LINK = "lbr_iiwa_link_7"
BASE_LINK = "lbr_iiwa_link_0"
BASE_HEIGHT = 0.05  # m, of the robot above the origin


def kuka_file() -> Path:
    """The URDF of the arm, with meshes beside it, in PyBullet's data. Raises MissingExtra without PyBullet."""
    data = required_extra("pybullet_data", "sim", "the kuka-surface scenario, of PyBullet,")
    return Path(data.getDataPath()) / "kuka_iiwa" / "model.urdf"


def kuka_urdf(config: KukaSurfaceConfig) -> str:
    """The URDF with the inertia of link 7, the joint damping and the base height of a scenario.

    A link `world` with a fixed joint carries the base. Meshes and materials are left out: no file path may go into a
    Dataset, and collisions are off. The base cannot move and is massless. The licence comment of the original stays at
    the head. Raises MissingExtra without PyBullet.
    """
    path = kuka_file()
    text = path.read_text(encoding="utf-8")
    root = ElementTree.fromstring(text)
    root[:] = [part for part in root if part.tag != "material"]
    for link in root.findall("link"):
        link[:] = link.findall("inertial")
    for dynamics in root.iter("dynamics"):
        dynamics.set("damping", repr(config.joint_damping))
    tool, base = (root.find(f"link[@name='{name}']/inertial") for name in (TOOL_LINK, BASE_LINK))
    if tool is None or base is None:
        seen = f"{path} lacks {TOOL_LINK!r} or {BASE_LINK!r} with inertia"
        raise RobotModelError(f"{seen}; install pybullet 3.2.6 or 3.2.7.")
    loaded = inertial_element(config.tool_mass, config.tool_center_of_mass, np.diag(config.tool_inertia))
    for link, element in ((tool, loaded), (base, inertial_element(0.0, np.zeros(3), np.zeros((3, 3))))):
        link[:] = ElementTree.fromstring(element)
    inside = f'<parent link="world"/><child link="{BASE_LINK}"/>'
    origin = f'<origin rpy="0 0 0" xyz="{numbers((0.0, 0.0, BASE_HEIGHT))}"/>'
    joint = f'<joint name="world_joint" type="fixed">{inside}{origin}</joint>'
    root[:0] = [ElementTree.Element("link", name="world"), ElementTree.fromstring(joint)]
    ElementTree.indent(root)
    changes = "<!-- Changed by forcegp: base mounted on `world`, tool inertia and damping set, meshes left out. -->\n"
    return text[: text.index("<robot")] + changes + ElementTree.tostring(root, encoding="unicode") + "\n"


def kuka_robot(config: KukaSurfaceConfig) -> Robot:
    """The arm on its base, with the tool of a scenario."""
    return Robot.from_urdf_text(kuka_urdf(config), source="kuka-surface", gravity=(0.0, 0.0, -config.gravity))


@dataclass(frozen=True)
class PointFriction:
    """Friction of a sliding point, F = -viscous p' - mu(s) |N| p't / sqrt(s^2 + smoothing^2).

    p't is the tangential part of its velocity p' and s the length of that; mu(s) = coulomb + (static - coulomb)
    exp(-(s / breakaway_velocity)^2) (Bo and Pavelescu; Olsson et al. 1998, section 2.1). Units N/(m/s) and m/s. Below
    `smoothing` the point creeps. Viscous friction acts on the whole velocity, as in Rath, Geist, Trimpe 2021.
    """

    viscous: float = 0.0
    coulomb: float = 0.0
    static: float = 0.0
    breakaway_velocity: float = 1.0
    smoothing: float = 1.0

    def coefficient(self, speed: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch"]:
        """`|F| / |N|` of dry friction at tangential speeds [m/s]."""
        return np.asarray(self._per_velocity(speed) * speed)

    def forces(
        self, velocity: trajectory.Vector, normal: trajectory.Vector
    ) -> tuple[trajectory.Vector, trajectory.Vector]:
        """Viscous friction [N], and dry friction per newton of normal force; `normal` is a unit vector."""
        tangential = velocity - (normal @ velocity) * normal
        return -self.viscous * velocity, -self._per_velocity(np.sqrt(tangential @ tangential)) * tangential

    def _per_velocity(self, speed: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch"] | float:
        level = self.coulomb + (self.static - self.coulomb) * np.exp(-((speed / self.breakaway_velocity) ** 2))
        return level / np.sqrt(speed**2 + self.smoothing**2)


class ContactForces(NamedTuple):
    """What acts at the tool: normal force [N], friction (3,) [N, world axes] and joint torques, `push` all of these."""

    multiplier: float
    tool_force: trajectory.Vector
    tool_torques: Float[np.ndarray, " nv"]
    in_contact: bool
    push: Float[np.ndarray, " nv"]


@dataclass
class IdealContact:
    """The tool point stays on the table from its first touch on: `A a = b` with Baumgarte's b, and friction there.

    Without `friction` it touches nothing. `omega` [rad/s] and `zeta` stabilise the constraint.
    """

    table: Surface
    friction: PointFriction | None
    omega: float
    zeta: float
    touched: bool = False

    def forces(self, state: trajectory.ArmState, applied: Float[np.ndarray, " nv"]) -> ContactForces:
        """Those under these torques [Nm]. SimulationError where friction leaves the normal force undetermined."""
        point = torch.from_numpy(state.position)
        distance = float(self.table.value(point))
        self.touched = self.touched or distance <= 0.0
        if not self.touched or self.friction is None:
            return ContactForces(0.0, np.zeros(3), np.zeros_like(applied), False, np.zeros_like(applied))
        normal, jacobian = self.table.gradient(point).numpy(), state.jacobian[:3]
        velocity, row = jacobian @ state.v, normal @ jacobian
        # A a = b, the second derivative of distance(p(q)) = 0 with Baumgarte's terms (Rath et al. 2021, eqs. 3 and 4)
        bias = normal @ state.bias_acceleration[:3] + velocity @ self.table.hessian(point).numpy() @ velocity
        b = -bias - 2.0 * self.zeta * self.omega * (row @ state.v) - self.omega**2 * distance

        viscous, per_newton = self.friction.forces(velocity, normal)
        torques, per_load = jacobian.T @ viscous, jacobian.T @ per_newton
        multiplier = multiplier_with_friction(state.mass, applied - state.bias + torques, row, per_load, float(b))
        friction, torques = viscous + abs(multiplier) * per_newton, torques + abs(multiplier) * per_load
        return ContactForces(multiplier, friction, torques, True, torques + multiplier * row)


Joints = Float[np.ndarray, " nv"]


def multiplier_with_friction(
    mass: Float[np.ndarray, "nv nv"], force: Joints, row: Joints, per_load: Joints, b: float
) -> float:
    """The multiplier [N] of `row . a = b` where friction gives the joint torques `per_load |lambda|`.

    `M a = force + per_load |lambda| + row^T lambda` makes `alpha lambda + gamma |lambda| = b - row M^-1 force` with
    `alpha = row M^-1 row^T` and `gamma = row M^-1 per_load`: two straight lines that meet at 0. For `|gamma| < alpha`
    both rise and there is exactly one solution; otherwise there are two or none, Painleve's paradox (Brogliato,
    Nonsmooth Mechanics, section 5.5), and SimulationError is raised.
    """
    free, per_newton, per_friction = np.linalg.solve(mass, np.stack([force, row, per_load], axis=1)).T
    alpha, gamma, needed = float(row @ per_newton), float(row @ per_friction), b - float(row @ free)
    if not abs(gamma) < alpha:
        by = f"{abs(gamma):.3g} 1/kg per newton of normal force, the normal force itself by {alpha:.3g} 1/kg"
        seen = f"friction changes the normal acceleration by {by}: the normal force is not determined"
        advice = "Use smaller friction coefficients or another posture (start_degrees)."
        raise SimulationError(f"{seen} (Painleve's paradox). {advice}")
    return needed / (alpha + gamma) if needed > 0 else needed / (alpha - gamma)


STEPS_PER_REPORT = 240
DIVERGED = 100.0  # rad/s

Motion = dict[str, np.ndarray]
"""Rows of an episode: q, v, u, a, time, in_contact; true joint_torques, tool_torques, tool_force, multiplier."""


def simulate_episode(config: KukaSurfaceConfig, robot: Robot, plant: RigidBodyDynamics, episode: int) -> Motion:
    """One continuous motion of the arm: v' = v + dt M^-1 (tau - h), q' = q + dt v', without limits of its joints.

    Raises SimulationError if the motion diverges, never touches the surface, or meets a singular posture.
    """
    settle, steps = config.settle_steps, config.settle_steps + config.rows_per_episode
    limits, table = np.array(config.torque_limits), trajectory.table_of(config)
    laws = joint_friction_of(config, robot)
    rows: list[dict[str, Any]] = []
    q, v = np.deg2rad(config.start_degrees), np.zeros(robot.nv)
    law = None if config.surface == "none" else tool_friction_of(config)
    contact = IdealContact(table, law, config.baumgarte_omega, config.baumgarte_zeta)
    tool, duration = (
        trajectory.ArmState.of(plant, TOOL_LINK, config.tool_point, q, v).position,
        steps * config.time_step,
    )
    flat = tool - [0.0, 0.0, (tool - trajectory.middle_of(config))[:2] @ trajectory.slope_of(config)]
    path = trajectory.random_path(config, flat, duration, np.random.default_rng([config.seed, episode, 0]))
    reference = trajectory.over_table(config, path.sample(config.time_step * np.arange(steps)))
    for step in range(steps):
        aim = reference[0][step], reference[1][step], reference[2][step]
        state = trajectory.ArmState.of(plant, TOOL_LINK, config.tool_point, q, v)
        try:
            wanted = trajectory.joint_acceleration(config, state, aim)
        except np.linalg.LinAlgError as error:
            seen = f"episode {episode}: the arm is in a singular posture at {step * config.time_step:.3g} s"
            advice = "Start from another posture (start_degrees) or keep the way-points nearer."
            raise SimulationError(f"{seen}. {advice}") from error
        asked = state.mass @ wanted + state.bias + config.joint_damping * v
        if config.pressing_force:
            normal = table.gradient(torch.from_numpy(state.position)).numpy()
            asked = asked - config.pressing_force * (normal @ state.jacobian[:3])
        u = np.clip(asked, -limits, limits) - config.joint_damping * v
        joint_torques = laws(v, u, q)
        forces = contact.forces(state, u + joint_torques)
        a = np.linalg.solve(state.mass, u + joint_torques + forces.push - state.bias)
        rows.append({"q": q, "v": v, "u": u, "a": a, "joint_torques": joint_torques, **forces._asdict()})
        v = v + config.time_step * a
        q = q + config.time_step * v
        if not np.abs(v).max() < DIVERGED:  # also NaN
            after = f"{(step + 1) * config.time_step:.3g} s (joint velocity {np.abs(v).max():.3g} rad/s)"
            advice = "Use the published constants, a shorter time_step or another controller."
            raise SimulationError(f"episode {episode} diverged after {after}. {advice}")
        if (step + 1) % STEPS_PER_REPORT == 0 or step + 1 == steps:
            tell(step + 1, steps)

    columns = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    if config.surface != "none" and not columns["in_contact"][: settle + 1].any():
        seen = f"episode {episode}: no contact within settle_seconds = {config.settle_seconds:.3g} s"
        raise SimulationError(f"{seen}. Give it more time, or a start posture nearer to the surface.")
    columns["time"] = config.time_step * np.arange(steps)
    return {name: values[settle:] for name, values in columns.items()}


def tool_friction_of(config: KukaSurfaceConfig) -> PointFriction:
    """The law of the ideal contact."""
    if config.friction == "viscous":
        return PointFriction(config.viscous_coefficient)
    falls = "breakaway" in force_class(str(config.friction)).coefficients
    static = config.static_coefficient if falls else config.coulomb_coefficient
    return PointFriction(0.0, config.coulomb_coefficient, static, config.breakaway_velocity, config.friction_smoothing)


def joint_friction_of(config: KukaSurfaceConfig, robot: Robot) -> Friction:
    """The laws that `joint_friction` names, with the numbers of the scenario where it gives none."""
    more = tuple(near - level for near, level in zip(config.joint_static, config.joint_coulomb, strict=True))
    numbers: dict[str, Any] = {"damping": config.joint_viscous, "level": config.joint_coulomb, "breakaway": more}
    numbers |= {"velocity_scale": config.joint_smoothing, "velocity": config.joint_breakaway_velocity}
    return laws_of_joints(config.joint_friction, robot, numbers)


def simulate_kuka_surface(config: KukaSurfaceConfig) -> Dataset:
    """Simulate the scenario and return what was measured, with the ground truth.

    Row k holds the state `(q, v)` before step k, the torque `u` during it (commanded minus joint damping), and the
    acceleration of the step. So with the true "a", "lambda" and "Q_U", `M(q) a + bias(q, v) = u + Q_U + A^T lambda` and
    `A a = b` in every row. The approach (`settle_seconds`) is left out. Equal `seed` and episode number give equal
    motion, whatever `noise`, `seconds` and `episodes` are. Raises SimulationError as `simulate_episode`.
    """
    robot, motions = kuka_robot(config), []
    plant = trajectory.compiled_plant(robot)
    for episode in range(config.episodes):
        with part(episode, config.episodes):
            motions.append(simulate_episode(config, robot, plant, episode))
    columns = {name: np.concatenate([motion[name] for motion in motions]) for name in motions[0]}
    contacts = () if config.surface == "none" else (Contact(TOOL_LINK, config.tool_point, trajectory.table_of(config)),)
    baumgarte = Baumgarte(config.baumgarte_omega, config.baumgarte_zeta) if contacts else None
    model = Model(robot, contacts, (Actuation(), RigidBodies()), baumgarte=baumgarte)
    signals = {name: columns[name] for name in ("q", "v", "u", "a", "time")}
    more = {"u": "commanded torque minus joint damping"}
    truth, parts = dict[str, np.ndarray](), dict[str, np.ndarray]()  # every force, as far as it exists
    if config.surface != "none":
        truth["lambda"] = columns["multiplier"][:, None]
        parts["Q_U.tool-friction"] = columns["tool_torques"]
        truth["force.tool-friction"] = columns["tool_force"]
    if config.joint_friction != "none":
        parts["Q_U.joint-friction"] = columns["joint_torques"]
    truth |= {**parts, "Q_U": sum(parts.values(), np.zeros_like(columns["a"]))}
    return trajectory.recorded("kuka-surface", config, model, signals, truth, more)
