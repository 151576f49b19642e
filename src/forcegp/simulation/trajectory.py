"""An arm and its tool, what that slides on, friction, a smooth path through way-points, and its controller."""

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import PPoly
from scipy.spatial.transform import Rotation

from forcegp import __version__
from forcegp.data import Dataset
from forcegp.errors import CompilerError, NumericalWarning
from forcegp.forces.joint_law import JointLaw
from forcegp.forces.joint_laws import Viscous
from forcegp.forces.registry import parse_forces
from forcegp.mechanics import Plane
from forcegp.mechanics.gauss_principle import State
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.robots.structure import RigidBodyDynamics
from forcegp.simulation.scenarios import KukaSurfaceConfig

Vector = Float[np.ndarray, "3"]
Numbers = Mapping[str, Any]
"""Coefficients by name, one number or one per joint; "velocity" stands for velocities that have no number here."""

Friction = Callable[..., Float[np.ndarray, "*batch nv"]]
"""(v, u, q), u [Nm or N] of the actuators, in joints; u, and q of a fixed base, may be None for 0 -> joint forces."""


@dataclass(frozen=True, eq=False)
class ArmState:
    """The arm before a step, with what its dynamics and its tool point are there: `bias` forces, and `Jdot v`."""

    q: Float[np.ndarray, " nv"]
    v: Float[np.ndarray, " nv"]
    mass: Float[np.ndarray, "nv nv"]
    bias: Float[np.ndarray, " nv"]
    position: Vector
    rotation: Float[np.ndarray, "3 3"]
    jacobian: Float[np.ndarray, "6 nv"]
    bias_acceleration: Float[np.ndarray, "6"]

    @staticmethod
    def of(plant: RigidBodyDynamics, link: str, point: tuple[float, ...], q: np.ndarray, v: np.ndarray) -> "ArmState":
        """That of a plant whose tool is a point of a link [m]."""
        at = torch.tensor(q), torch.tensor(v)
        mass, bias = (x.numpy() for x in plant.mass_matrix_and_bias(*at))
        pose, jacobian, drift = (x.numpy() for x in plant.frame_motion(*at, link, point))
        return ArmState(q, v, mass, bias, pose[:3, :3] @ point + pose[:3, 3], pose[:3, :3], jacobian, drift)


def compiled_plant(robot: Robot) -> RigidBodyDynamics:
    """The robot as machine code; without a C compiler the robot itself, with a warning."""
    plant = robot.compile()
    try:
        plant.mass_matrix(robot.neutral())
    except CompilerError as error:
        warnings.warn(f"PyTorch simulates, some times slower: {error}", NumericalWarning, stacklevel=3)
        return robot
    return plant


Motions = tuple[Float[np.ndarray, "times 3"], Float[np.ndarray, "times 3"], Float[np.ndarray, "times 3"]]


def middle_of(config: KukaSurfaceConfig) -> Vector:
    """Of the region of way-points, on the table [m]."""
    return np.array([np.mean(config.waypoint_x), np.mean(config.waypoint_y), config.surface_height])


def table_of(config: KukaSurfaceConfig) -> Plane:
    """The table of a scenario; for `surface="none"` the plane that way-points keep above."""
    angle = np.deg2rad(config.tilt_degrees) if config.surface == "tilted" else 0.0
    x, y = np.array(config.tilt_axis) / np.hypot(*config.tilt_axis)
    # Rodrigues' formula for the vertical unit vector about the horizontal axis (x, y, 0).
    upward = np.array([y * np.sin(angle), -x * np.sin(angle), np.cos(angle)])
    return Plane(tuple(upward.tolist()), float(upward @ middle_of(config)))


def slope_of(config: KukaSurfaceConfig) -> Float[np.ndarray, "2"]:
    """How the height of the table rises along x and y."""
    *normal, upwards = table_of(config).normal
    return -np.array(normal) / upwards


@dataclass(frozen=True, eq=False)
class SegmentPath:
    """Straight lines with parabolic blends: constant acceleration, constant velocity, constant deceleration.

    Craig, Introduction to Robotics, section 7.3 ("linear function with parabolic blends"), along each segment's length.

    points: (segments + 1, 3) [m]; durations: (segments,) [s]; accelerations: (segments,) [m/s^2], at least
    `4 length / duration^2`, with which the blends meet in the middle.
    """

    points: Float[np.ndarray, "corners 3"]
    durations: Float[np.ndarray, " segments"]
    accelerations: Float[np.ndarray, " segments"]

    def sample(self, time: Float[np.ndarray, " times"]) -> Motions:
        """Position [m], velocity [m/s] and acceleration [m/s^2] at the given times [s]; at rest before and after."""
        starts = np.concatenate([[0.0], np.cumsum(self.durations)])
        step, acceleration = np.diff(self.points, axis=0), self.accelerations
        length = np.linalg.norm(step, axis=1)
        root = np.sqrt(np.maximum((acceleration * self.durations) ** 2 - 4.0 * acceleration * length, 0.0))
        blend = 0.5 * self.durations - 0.5 * root / acceleration
        push = step * (acceleration / np.where(length > 0, length, 1.0))[:, None]
        ends = np.append(np.stack([starts[:-1], starts[:-1] + blend, starts[1:] - blend], axis=1), starts[-1])
        pushes = np.stack([push, 0.0 * push, -push], axis=1).reshape(1, -1, 3)
        change = PPoly(pushes, np.maximum.accumulate(ends))  # by rounding two blends may overlap
        inside, at = ((time >= 0) & (time < starts[-1]))[:, None], np.clip(time, 0.0, starts[-1])
        travelled, speed = change.antiderivative(2), change.antiderivative()
        return self.points[0] + travelled(at), speed(at) * inside, change(at) * inside


def over_table(config: KukaSurfaceConfig, motions: Motions) -> Motions:
    """Motions over a horizontal table, moved up and down to follow its true height."""
    for values, middle in zip(motions, (middle_of(config)[:2], 0.0, 0.0), strict=True):
        values[:, 2] += (values[:, :2] - middle) @ slope_of(config)
    return motions


def random_path(config: KukaSurfaceConfig, start: Vector, seconds: float, rng: np.random.Generator) -> SegmentPath:
    """Random way-points at `config.waypoint_height`, from `start` [m], for at least `seconds` [s]."""
    points, durations = [np.asarray(start, dtype=np.float64)], []
    while sum(durations) < seconds:
        durations.append(rng.uniform(*config.segment_seconds))
        x, y = rng.uniform(*config.waypoint_x), rng.uniform(*config.waypoint_y)
        points.append(np.array([x, y, config.waypoint_height]))
    corners, times = np.array(points), np.array(durations)
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    return SegmentPath(corners, times, np.maximum(config.least_acceleration, 4.0 * lengths / times**2))


TOOL_ORIENTATION = np.diag([-1.0, 1.0, -1.0])  # the tool points straight down


def joint_acceleration(
    config: KukaSurfaceConfig, state: ArmState, reference: tuple[Vector, Vector, Vector]
) -> Float[np.ndarray, " nv"]:
    """Commanded joint acceleration [rad/s^2] under which the tool follows an aimed position, velocity and acceleration.

    Resolved-acceleration control (Siciliano et al., Robotics, section 8.6.2) with a null-space posture: with `e` the
    error of the tool (translation; rotation vector),
    `J^+ (x_ref'' + 2 zeta omega e' + omega^2 e - Jdot v) + (I - J^+ J) S (K (q_0 - q) - D v)`; `S` selects joints.
    """
    aim, aim_velocity, aim_acceleration = reference
    omega, gain = config.controller_omega, 2.0 * config.controller_zeta * config.controller_omega
    jacobian, task = state.jacobian, np.empty(6)
    velocity, turn = jacobian @ state.v, Rotation.from_matrix(TOOL_ORIENTATION @ state.rotation.T).as_rotvec()
    task[:3] = aim_acceleration + gain * (aim_velocity - velocity[:3]) + omega**2 * (aim - state.position)
    task[3:] = -gain * velocity[3:] + omega**2 * turn
    pull = config.null_space_stiffness * (np.deg2rad(config.start_degrees) - state.q)
    selected = np.isin(np.arange(1, 8), config.null_space_joints).astype(np.float64)
    posture = selected * (pull - config.null_space_damping * state.v)
    # J^+ (task - Jdot v) + (I - J^+ J) posture, with J^+ = J^T (J J^T)^-1
    residual = task - state.bias_acceleration - jacobian @ posture
    return posture + jacobian.T @ np.linalg.solve(jacobian @ jacobian.T, residual)


RATE = 240  # rows per second

Columns = Mapping[str, np.ndarray]


def recorded(
    scenario: str, config: Any, model: Model, motion: Columns, truth: Columns, metadata: Mapping[str, Any]
) -> Dataset:
    """Rows of `config.episodes` episodes of equal length: q, v, u and the true a of `motion`, which gets its noise.

    The noise has a stream of its own for each episode, so that it leaves the motion of a seed as it is. Rows are
    1 / RATE apart, unless `motion` has their time.
    """
    nv, steps = model.robot.nv, len(motion["a"]) // config.episodes
    streams = [np.random.default_rng([config.seed, episode, 1]) for episode in range(config.episodes)]
    noise = np.concatenate([stream.standard_normal((steps, nv)) for stream in streams])
    about = {"scenario": scenario, "config": dataclasses.asdict(config), "versions": {"forcegp": __version__}}
    rows: dict[str, Any] = {"time": np.tile(np.arange(steps) / RATE, config.episodes), **motion}
    rows |= {"a": motion["a"] + config.noise * noise, "episode": np.repeat(np.arange(config.episodes), steps)}
    rows |= {"truth": {"a": motion["a"], **truth}, "metadata": about | dict(metadata)}
    return Dataset(**rows, model=model, noise_std=np.full(nv, config.noise) if config.noise > 0 else None)


def laws_of_joints(expression: str, robot: Robot, numbers: Numbers) -> Friction:
    """The laws of this expression (`parse_forces`) with viscous friction, step by step; none for "none".

    Coefficients that it does not give have these numbers, or their defaults.
    """
    forces = () if expression == "none" else parse_forces(expression)
    laws = forces if not forces or any(isinstance(force, Viscous) for force in forces) else (Viscous(), *forces)
    known = []
    for law in laws:
        assert isinstance(law, JointLaw), "`require_joint_friction` sees to it"
        found = {}
        for name, coefficient in law.coefficients.items():
            given = getattr(law, name)
            usual = numbers["velocity"] if coefficient.unit == "velocity" else coefficient.default
            found[name] = numbers.get(name, usual) if given is None else given
        known.append(law.with_values(found).bound_to(robot))

    def friction(v: np.ndarray, u: np.ndarray | None = None, q: np.ndarray | None = None) -> np.ndarray:
        at_u, at_q = (torch.tensor(np.zeros_like(v) if each is None else each) for each in (u, q))
        state = State(at_q, torch.tensor(v), at_u, robot)
        return sum((law.force(state).numpy() for law in known), np.zeros_like(v))

    return friction
