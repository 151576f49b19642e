"""The `kuka-surface` scenario: an iiwa slides its tool on a plane with viscous friction (Rath, Geist, Trimpe 2021)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from jaxtyping import Float

from forcegp import __version__
from forcegp.data import Dataset, units_for
from forcegp.errors import SimulationError
from forcegp.mechanics import Actuation, Baumgarte, Contact, MechanicalSystem, Plane, RigidBodyBias
from forcegp.robots import Robot
from forcegp.simulation.bullet import BulletArm
from forcegp.simulation.kuka_description import TOOL_LINK, kuka_urdf
from forcegp.simulation.kuka_surface_config import KukaSurfaceConfig
from forcegp.simulation.task_space_controller import TaskSpaceController
from forcegp.simulation.trajectory import random_path

Progress = Callable[[int, int], None]
"""Called as `progress(steps done, steps in total)`."""

TOOL_ORIENTATION = np.array([0.0, -1.0, 0.0, 0.0])
"""Euler angles (0, -pi, 0) as a quaternion (x, y, z, w): the tool points straight down."""

STEPS_PER_REPORT = 240
LARGEST_GAP = 5e-3  # m between tool and surface; the integrator's drift is below 1 mm
LARGEST_LIMIT_EXCESS = np.deg2rad(1.0)  # the start posture itself lies on the limit of joint 5
LARGEST_SATURATED_SHARE = 0.01
DIVERGED = 100.0  # rad/s


def simulate_kuka_surface(config: KukaSurfaceConfig, progress: Progress | None = None) -> Dataset:
    """Simulate the scenario and return what was measured, with the ground truth.

    Row k holds the state `(q, v)` before step k, the torque `u` during it (commanded torque minus joint damping), and
    the acceleration `(v[k+1] - v[k]) / time_step`, which PyBullet's integrator takes as constant over the step. So in
    every row, with the true "a", "lambda" and "Q_U", `M(q) a + bias(q, v) = u + Q_U + A^T lambda` and `A a = b`.
    All rows are in contact: the approach (`settle_seconds`) is left out. Nothing is cut at the end (the paper drops the
    edge of its last segment; here the recording ends in mid-motion). Every episode is one continuous motion with its
    own way-points; equal `seed` and episode number give equal motion, whatever `noise`, `seconds` and `episodes` are.

    Raises MissingExtra without PyBullet, and SimulationError if the motion diverges, loses the surface, leaves the
    joint limits or saturates the torques, which the published constants do not do.
    """
    urdf = kuka_urdf(
        base_height=config.base_height,
        tool_mass=config.tool_mass,
        tool_center_of_mass=config.tool_center_of_mass,
        tool_inertia=config.tool_inertia,
        joint_damping=config.joint_damping,
    )
    robot = Robot.from_urdf_text(urdf, source="kuka-surface", gravity=(0.0, 0.0, -config.gravity))
    motions = []
    per_episode = config.steps // config.episodes
    for episode in range(config.episodes):
        done = episode * per_episode

        def report(step: int, done: int = done) -> None:
            if progress is not None:
                progress(done + step, config.steps)

        motion = _simulate_episode(config, urdf, episode, report)
        _require_useful(config, robot, motion, episode)
        motions.append(motion)
    return _dataset(config, robot, motions)


@dataclass(frozen=True, eq=False)
class _Motion:
    """The recorded rows of one episode."""

    q: Float[np.ndarray, "rows nv"]
    v: Float[np.ndarray, "rows nv"]
    u: Float[np.ndarray, "rows nv"]
    a: Float[np.ndarray, "rows nv"]
    multiplier: Float[np.ndarray, "rows 1"]
    unknown: Float[np.ndarray, "rows nv"]
    gap: Float[np.ndarray, " rows"]
    saturated: Float[np.ndarray, " rows"]
    time: Float[np.ndarray, " rows"]


def _random(config: KukaSurfaceConfig, episode: int, stream: int) -> np.random.Generator:
    """Stream 0 draws way-points, 1 noise: independent of each other and of other episodes and seeds."""
    return np.random.default_rng([config.seed, episode, stream])


def _controller(config: KukaSurfaceConfig) -> TaskSpaceController:
    selected = np.zeros(7)
    selected[[joint - 1 for joint in config.null_space_joints]] = 1.0
    return TaskSpaceController(
        omega=config.controller_omega,
        zeta=config.controller_zeta,
        orientation=TOOL_ORIENTATION,
        posture=np.deg2rad(config.start_degrees),
        selected=selected,
        stiffness=config.null_space_stiffness,
        damping=config.null_space_damping,
    )


def _simulate_episode(config: KukaSurfaceConfig, urdf: str, episode: int, report: Callable[[int], None]) -> _Motion:
    settle, rows = config.settle_steps, config.rows_per_episode
    steps = settle + rows
    start, limits = np.deg2rad(config.start_degrees), np.array(config.torque_limits)
    controller = _controller(config)
    columns = {name: np.zeros((steps + 1, 7)) for name in ("q", "v", "u", "unknown")}
    multiplier, gap, saturated = np.zeros((steps, 1)), np.zeros(steps), np.zeros(steps)
    touched_at: int | None = None

    with BulletArm(urdf, gravity=config.gravity, time_step=config.time_step, tool_point=config.tool_point) as arm:
        arm.reset(start, np.zeros(7))
        path = random_path(config, arm.tool(np.zeros(7))[0], steps * config.time_step, _random(config, episode, 0))
        reference = path.sample(config.time_step * np.arange(steps))
        for step in range(steps):
            q, v = arm.state()
            _require_bounded(config, v, episode, step)
            mass, bias = arm.mass_matrix(q), arm.bias_forces(q, v)
            position, quaternion, jacobian, bias_acceleration = arm.tool(v)
            aim = (reference[0][step], reference[1][step], reference[2][step])
            try:
                wanted = controller.joint_acceleration(q, v, jacobian, bias_acceleration, position, quaternion, aim)
            except np.linalg.LinAlgError as error:
                raise SimulationError(
                    f"episode {episode}: the arm is in a singular posture at {step * config.time_step:.3g} s. "
                    "Start from another posture (start_degrees) or keep the way-points nearer."
                ) from error
            asked = mass @ wanted + bias + config.joint_damping * v
            commanded = np.clip(asked, -limits, limits)
            u = commanded - config.joint_damping * v

            gap[step] = position[2] - config.surface_height
            if touched_at is None and gap[step] <= 0.0:
                touched_at = step
            torque = u
            if touched_at is not None:
                unknown = jacobian[:3].T @ (-config.friction * (jacobian[:3] @ v))
                force = _multiplier(config, mass, u - bias + unknown, jacobian[2], bias_acceleration[2], v, gap[step])
                torque = u + unknown + force * jacobian[2]
                columns["unknown"][step], multiplier[step] = unknown, force
            arm.step(torque)
            columns["q"][step], columns["v"][step], columns["u"][step] = q, v, u
            saturated[step] = (commanded != asked).any()
            if (step + 1) % STEPS_PER_REPORT == 0 or step + 1 == steps:
                report(step + 1)
        columns["q"][steps], columns["v"][steps] = arm.state()
        _require_bounded(config, columns["v"][steps], episode, steps)

    if touched_at is None or touched_at > settle:
        raise SimulationError(
            f"episode {episode}: no contact within settle_seconds = {config.settle_seconds:.3g} s. "
            "Give it more time, or a start posture nearer to the surface."
        )
    recorded = slice(settle, steps)
    acceleration = np.diff(columns["v"], axis=0) / config.time_step
    return _Motion(
        q=columns["q"][recorded],
        v=columns["v"][recorded],
        u=columns["u"][recorded],
        a=acceleration[recorded],
        multiplier=multiplier[recorded],
        unknown=columns["unknown"][recorded],
        gap=gap[recorded],
        saturated=saturated[recorded],
        time=config.time_step * np.arange(settle, steps),
    )


def _require_bounded(config: KukaSurfaceConfig, v: Float[np.ndarray, " nv"], episode: int, step: int) -> None:
    if not np.abs(v).max() < DIVERGED:  # also NaN
        raise SimulationError(
            f"episode {episode} diverged after {step * config.time_step:.3g} s (joint velocity {np.abs(v).max():.3g} "
            "rad/s). Use the published constants, a shorter time_step or a softer controller."
        )


def _multiplier(
    config: KukaSurfaceConfig,
    mass: Float[np.ndarray, "nv nv"],
    force: Float[np.ndarray, " nv"],
    normal: Float[np.ndarray, " nv"],
    bias_acceleration: float,
    v: Float[np.ndarray, " nv"],
    gap: float,
) -> float:
    """`lambda = (b - A M^-1 Q) / (A M^-1 A^T)` [N] of the plane, with Baumgarte's `b` (paper, eqs. 3 and 4)."""
    omega, zeta = config.baumgarte_omega, config.baumgarte_zeta
    b = -bias_acceleration - 2.0 * zeta * omega * (normal @ v) - omega**2 * gap
    free, per_newton = np.linalg.solve(mass, np.stack([force, normal], axis=1)).T
    return float((b - normal @ free) / (normal @ per_newton))


def _require_useful(config: KukaSurfaceConfig, robot: Robot, motion: _Motion, episode: int) -> None:
    """Refuse rows that an ideal robot on an ideal plane would not give."""
    remedy = "Use the published constants, or slower segments (segment_seconds) and way-points within reach."
    gap = float(np.abs(motion.gap).max())
    if not gap < LARGEST_GAP:
        raise SimulationError(f"episode {episode}: the tool leaves the surface by {gap:.3g} m. {remedy}")
    lower = np.array([joint.lower for joint in robot.joints])
    upper = np.array([joint.upper for joint in robot.joints])
    excess = np.maximum(lower - motion.q, motion.q - upper).max(axis=0)
    if excess.max() > LARGEST_LIMIT_EXCESS:
        joint = robot.joint_names[int(excess.argmax())]
        raise SimulationError(
            f"episode {episode}: {joint} passes its limit by {np.rad2deg(excess.max()):.3g} deg. {remedy}"
        )
    share = float(motion.saturated.mean())
    if share > LARGEST_SATURATED_SHARE:
        raise SimulationError(f"episode {episode}: {share:.1%} of the torques are at their limit. {remedy}")


def _dataset(config: KukaSurfaceConfig, robot: Robot, motions: list[_Motion]) -> Dataset:
    contact = Contact(TOOL_LINK, config.tool_point, Plane((0.0, 0.0, 1.0), config.surface_height))
    system = MechanicalSystem(
        robot=robot,
        contacts=(contact,),
        known_forces=(Actuation(), RigidBodyBias()),
        baumgarte=Baumgarte(config.baumgarte_omega, config.baumgarte_zeta),
    )
    true_acceleration = np.concatenate([motion.a for motion in motions])
    noise = [_random(config, episode, 1).standard_normal(motion.a.shape) for episode, motion in enumerate(motions)]
    return Dataset(
        q=np.concatenate([motion.q for motion in motions]),
        v=np.concatenate([motion.v for motion in motions]),
        u=np.concatenate([motion.u for motion in motions]),
        a=true_acceleration + config.noise * np.concatenate(noise),
        time=np.concatenate([motion.time for motion in motions]),
        episode=np.repeat(np.arange(config.episodes), config.rows_per_episode),
        joint_names=tuple(robot.joint_names),
        units=units_for(robot),
        system=system,
        noise_std=np.full(robot.nv, config.noise) if config.noise > 0 else None,
        truth={
            "a": true_acceleration,
            "lambda": np.concatenate([motion.multiplier for motion in motions]),
            "Q_U": np.concatenate([motion.unknown for motion in motions]),
        },
        metadata={
            "scenario": "kuka-surface",
            "config": dataclasses.asdict(config),
            "u": "commanded torque minus joint damping",
            "versions": {"forcegp": __version__, "pybullet": _pybullet_version(), "numpy": np.__version__},
        },
    )


def _pybullet_version() -> str:
    try:
        return version("pybullet")
    except PackageNotFoundError:  # built from source without package metadata
        return "unknown"
