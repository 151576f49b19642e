"""One episode of the `kuka-surface` scenario: controller, friction and contact in the loop, recorded row by row."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from forcegp.errors import MissingExtra, RobotModelError, SimulationError
from forcegp.forces.registry import force_class
from forcegp.robots import Robot
from forcegp.robots.urdf import numbers
from forcegp.simulation.bullet import ArmState, BulletArm
from forcegp.simulation.contact_forces import (
    BulletContact,
    DryFriction,
    IdealContact,
    NoContact,
    PointFriction,
    RoughPatch,
    ViscousFriction,
    with_tool_sphere,
)
from forcegp.simulation.joint_friction import JointFrictionLaw
from forcegp.simulation.scenarios import KukaSurfaceConfig
from forcegp.simulation.trajectory import PathOverTable, Table, TaskSpaceController, table_of

TOOL_LINK = "lbr_iiwa_link_7"
BASE_LINK = "lbr_iiwa_link_0"


def kuka_file() -> Path:
    """The URDF of the arm, with meshes beside it, in PyBullet's data. Raises MissingExtra without PyBullet."""
    try:
        import pybullet_data
    except ImportError as error:
        raise MissingExtra("the kuka-surface scenario needs PyBullet: pip install 'forcegp[sim]'") from error
    return Path(pybullet_data.getDataPath()) / "kuka_iiwa" / "model.urdf"


def kuka_urdf(config: KukaSurfaceConfig) -> str:
    """The URDF with the inertia of link 7, the joint damping and the base height of a scenario.

    A link `world` with a fixed joint carries the base. Meshes and materials are left out: no file path may go into a
    Dataset, and collisions are off. The base cannot move and is massless. The licence comment of the original stays at
    the head. Raises MissingExtra without PyBullet.
    """
    path = kuka_file()
    text = path.read_text(encoding="utf-8")
    root = ElementTree.fromstring(text)
    for unused in root.findall("material"):
        root.remove(unused)
    for link in root.findall("link"):
        for child in list(link):
            if child.tag != "inertial":
                link.remove(child)
    for dynamics in root.iter("dynamics"):
        dynamics.set("damping", repr(config.joint_damping))
    tool, base = (root.find(f"link[@name='{name}']/inertial") for name in (TOOL_LINK, BASE_LINK))
    if tool is None or base is None:
        raise RobotModelError(
            f"{path} lacks {TOOL_LINK!r} or {BASE_LINK!r} with inertia; install pybullet 3.2.6 or 3.2.7."
        )
    _write_inertial(tool, config.tool_mass, config.tool_center_of_mass, config.tool_inertia)
    _write_inertial(base, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    joint = (
        f'<joint name="world_joint" type="fixed"><parent link="world"/><child link="{BASE_LINK}"/>'
        f'<origin rpy="0 0 0" xyz="{numbers((0.0, 0.0, config.base_height))}"/></joint>'
    )
    root[:0] = [ElementTree.Element("link", name="world"), ElementTree.fromstring(joint)]
    ElementTree.indent(root)
    head = text[: text.index("<robot")]
    changes = "<!-- Changed by forcegp: base mounted on `world`, tool inertia and damping set, meshes left out. -->\n"
    return head + changes + ElementTree.tostring(root, encoding="unicode") + "\n"


def _write_inertial(
    inertial: ElementTree.Element, mass: float, center_of_mass: Sequence[float], moments: Sequence[float]
) -> None:
    ixx, iyy, izz = map(float, moments)
    inertial[:] = ElementTree.fromstring(
        f'<inertial><origin rpy="0 0 0" xyz="{numbers(center_of_mass)}"/><mass value="{float(mass)}"/>'
        f'<inertia ixy="0" ixz="0" iyz="0" ixx="{ixx}" iyy="{iyy}" izz="{izz}"/></inertial>'
    )


STEPS_PER_REPORT = 240
DIVERGED = 100.0  # rad/s


@dataclass(frozen=True, eq=False)
class Motion:
    """The recorded rows of one episode; forces are the true ones."""

    q: Float[np.ndarray, "rows nv"]
    v: Float[np.ndarray, "rows nv"]
    u: Float[np.ndarray, "rows nv"]
    a: Float[np.ndarray, "rows nv"]
    multiplier: Float[np.ndarray, " rows"]
    tool_force: Float[np.ndarray, "rows 3"]
    tool_torques: Float[np.ndarray, "rows nv"]
    joint_torques: Float[np.ndarray, "rows nv"]
    in_contact: Bool[np.ndarray, " rows"]
    gap: Float[np.ndarray, " rows"]
    saturated: Bool[np.ndarray, " rows"]
    time: Float[np.ndarray, " rows"]


def random_stream(config: KukaSurfaceConfig, episode: int, stream: int) -> np.random.Generator:
    """Stream 0 draws way-points, 1 noise, 2 lifts: independent of each other and of other episodes and seeds."""
    return np.random.default_rng([config.seed, episode, stream])


def simulate_episode(
    config: KukaSurfaceConfig, robot: Robot, urdf: str, episode: int, report: Callable[[int], None]
) -> Motion:
    """One continuous motion of the arm. `report(steps done)` is called now and then.

    Raises SimulationError if the motion diverges, never touches the surface, or meets a singular posture.
    """
    settle, steps = config.settle_steps, config.settle_steps + config.rows_per_episode
    limits, table, controller = np.array(config.torque_limits), table_of(config), TaskSpaceController(config)
    joint_law = None if config.joint_friction == "none" else JointFrictionLaw(config, robot)
    columns: dict[str, np.ndarray] = {}
    if config.contact == "bullet":
        urdf = with_tool_sphere(urdf, TOOL_LINK, config.tool_point)

    with BulletArm(urdf, gravity=config.gravity, time_step=config.time_step, tool_point=config.tool_point) as arm:
        arm.reset(np.deg2rad(config.start_degrees), np.zeros(7))
        contact = _contact(config, table, arm)
        streams = (random_stream(config, episode, stream) for stream in (0, 2))
        tool = arm.tool(np.zeros(7))[0]
        path = PathOverTable.random(config, table, tool, steps * config.time_step, *streams)
        reference = path.sample(config.time_step * np.arange(steps))
        for step in range(steps):
            aim = reference[0][step], reference[1][step], reference[2][step]
            _require_bounded(config, arm.state()[1], episode, step)
            state = ArmState.of(arm)
            v = state.v
            try:
                wanted = controller.joint_acceleration(state, aim)
            except np.linalg.LinAlgError as error:
                raise SimulationError(
                    f"episode {episode}: the arm is in a singular posture at {step * config.time_step:.3g} s. "
                    "Start from another posture (start_degrees) or keep the way-points nearer."
                ) from error
            asked = state.mass @ wanted + state.bias + config.joint_damping * v
            if config.pressing_force:
                asked = asked - config.pressing_force * (table.normal(state.position) @ state.jacobian[:3])
            commanded = np.clip(asked, -limits, limits)
            u = commanded - config.joint_damping * v
            now = step * config.time_step
            joint_torques = np.zeros(7) if joint_law is None else joint_law.step(v, u, state.mass, now)
            forces = contact.step(arm, state, u + joint_torques)
            row = {"q": state.q, "v": v, "u": u, "joint_torques": joint_torques}
            row |= {"tool_force": forces.friction, "tool_torques": forces.joint_friction_torques}
            row |= {"multiplier": forces.normal_force, "in_contact": forces.acts, "gap": table.distance(state.position)}
            row["saturated"] = (commanded != asked).any()
            if step == 0:
                columns = {name: np.zeros((steps, *np.shape(x)), np.asarray(x).dtype) for name, x in row.items()}
            for name, value in row.items():
                columns[name][step] = value
            if (step + 1) % STEPS_PER_REPORT == 0 or step + 1 == steps:
                report(step + 1)
        last_v = arm.state()[1]
        _require_bounded(config, last_v, episode, steps)

    if config.surface != "none" and not columns["in_contact"][: settle + 1].any():
        raise SimulationError(
            f"episode {episode}: no contact within settle_seconds = {config.settle_seconds:.3g} s. "
            "Give it more time, or a start posture nearer to the surface."
        )
    columns["a"] = np.diff(columns["v"], axis=0, append=last_v[None]) / config.time_step
    columns["time"] = config.time_step * np.arange(steps)
    return Motion(**{name: values[settle:] for name, values in columns.items()})


def _contact(config: KukaSurfaceConfig, table: Table, arm: BulletArm) -> NoContact | IdealContact | BulletContact:
    if config.surface == "none":
        return NoContact()
    if config.contact == "bullet":
        return BulletContact(arm, table, config.coulomb_coefficient)
    patch = None if config.patch_factor == 1.0 else RoughPatch(*config.patch_x, factor=config.patch_factor)
    return IdealContact(table, tool_friction_of(config), config.baumgarte_omega, config.baumgarte_zeta, patch)


def tool_friction_of(config: KukaSurfaceConfig) -> PointFriction:
    """The law of the ideal contact."""
    if config.friction == "viscous":
        return ViscousFriction(config.viscous_coefficient)
    falls = "breakaway" in force_class(str(config.friction)).coefficients
    static = config.static_coefficient if falls else config.coulomb_coefficient
    return DryFriction(config.coulomb_coefficient, static, config.breakaway_velocity, config.friction_smoothing)


def _require_bounded(config: KukaSurfaceConfig, v: Float[np.ndarray, " nv"], episode: int, step: int) -> None:
    if not np.abs(v).max() < DIVERGED:  # also NaN
        raise SimulationError(
            f"episode {episode} diverged after {step * config.time_step:.3g} s (joint velocity {np.abs(v).max():.3g} "
            "rad/s). Use the published constants, a shorter time_step or a softer controller."
        )
