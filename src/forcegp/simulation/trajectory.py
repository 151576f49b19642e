"""An arm in PyBullet, what its tool slides on, a smooth path through way-points, and the controller that follows it."""

from __future__ import annotations

import dataclasses
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from forcegp import __version__
from forcegp.data import Dataset
from forcegp.errors import MissingExtra, SimulationError
from forcegp.mechanics import Plane, Sphere
from forcegp.model import Model
from forcegp.simulation.scenarios import KukaSurfaceConfig


class BulletArm:
    """A serial arm of revolute joints whose only forces are gravity, its own inertia and the torques given to `step`.

    One step is `v' = v + time_step * M(q)^-1 (tau - h(q, v))`, `q' = q + time_step * v'`: joint motors, limits, damping
    and collisions are off. `tool_point` [m] is fixed in the frame of the last link; `gravity` [m/s^2] acts along -z;
    `bullet`, `client`, `body` and `joints` are PyBullet's. A context manager. Raises MissingExtra without PyBullet, and
    SimulationError for a link whose inertia is not along its axes.
    """

    def __init__(self, urdf: str, *, gravity: float, time_step: float, tool_point: Sequence[float]):
        try:
            import pybullet
        except ImportError as error:
            raise MissingExtra("simulation needs PyBullet: pip install 'forcegp[sim]'") from error
        self.bullet: Any = pybullet
        self.time_step = time_step
        self.client = pybullet.connect(pybullet.DIRECT)
        self._client = {"physicsClientId": self.client}
        try:
            self._load(urdf, gravity, time_step, tool_point)
        except BaseException:
            self.close()
            raise

    def _load(self, urdf: str, gravity: float, time_step: float, tool_point: Sequence[float]) -> None:
        bullet, client = self.bullet, self._client
        bullet.setGravity(0.0, 0.0, -gravity, **client)
        bullet.setPhysicsEngineParameter(fixedTimeStep=time_step, numSubSteps=0, **client)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(_without_limits_and_damping(urdf), encoding="utf-8")
            # Without this flag Bullet would compute the inertia of every link from its (missing) collision shape.
            flags = bullet.URDF_USE_INERTIA_FROM_FILE
            self.body = bullet.loadURDF(str(path), useFixedBase=True, flags=flags, **client)
        joints = range(bullet.getNumJoints(self.body, **client))
        information = [bullet.getJointInfo(self.body, index, **client) for index in joints]
        for link in range(-1, len(information)):
            # Damping of links is 0.04 by default. Masses must not be changed in this way: the mass matrix would go
            # stale (bullet3 issue 4809); they are in the URDF.
            undamped = {"linearDamping": 0.0, "angularDamping": 0.0, "maxJointVelocity": 1e6}
            bullet.changeDynamics(self.body, link, **undamped, **client)
        moving = [joint for joint in information if joint[2] == bullet.JOINT_REVOLUTE]
        self.joints = [joint[0] for joint in moving]
        frames = bullet.getLinkStates(self.body, self.joints, **client)
        axes, centers = np.array([joint[13] for joint in moving]), np.array([frame[2] for frame in frames])
        # What turns with each link: joint axis, centre of mass, tool point (meaningful for the last link only).
        self._local = np.stack([axes, centers, np.broadcast_to(tool_point, axes.shape)], axis=2)
        if not np.array_equal([frame[3] for frame in frames], [(0.0, 0.0, 0.0, 1.0)] * len(moving)):
            raise SimulationError(
                "every link's inertia must be given along the axes of its link (rpy 0 0 0, diagonal)."
            )
        nv = len(moving)
        bullet.setJointMotorControlArray(self.body, self.joints, bullet.VELOCITY_CONTROL, forces=[0.0] * nv, **client)
        self._zeros = [0.0] * nv

    def __enter__(self) -> "BulletArm":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect from PyBullet."""
        if self.bullet.isConnected(self.client):
            self.bullet.disconnect(self.client)

    def reset(self, q: Float[np.ndarray, " nv"], v: Float[np.ndarray, " nv"]) -> None:
        """Put the arm into a state."""
        for index, position, velocity in zip(self.joints, q.tolist(), v.tolist(), strict=True):
            self.bullet.resetJointState(self.body, index, position, velocity, **self._client)

    def state(self) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"]]:
        """Joint positions [rad] and velocities [rad/s]."""
        states = self.bullet.getJointStates(self.body, self.joints, **self._client)
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])

    def mass_matrix(self, q: Float[np.ndarray, " nv"]) -> Float[np.ndarray, "nv nv"]:
        """Joint-space inertia [kg m^2]."""
        return np.array(self.bullet.calculateMassMatrix(self.body, q.tolist(), **self._client))

    def bias_forces(self, q: Float[np.ndarray, " nv"], v: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
        """Coriolis, centrifugal and gravity torques [Nm]: what holds the joint acceleration at zero."""
        state = (q.tolist(), v.tolist(), self._zeros)
        return np.array(self.bullet.calculateInverseDynamics(self.body, *state, **self._client))

    def tool(
        self, v: Float[np.ndarray, " nv"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"], Float[np.ndarray, "6 nv"], Float[np.ndarray, "6"]]:
        """Tool point [m], tool orientation (x, y, z, w), Jacobian (linear; angular) at the tool point, and `Jdot v`.

        From the joint axes `z_i` and origins `p_i` in the world: columns `l_i = z_i x (p - p_i)` and `z_i` (Siciliano
        et al., Robotics, section 3.1.3). With `w_i = z_1 v_1 + ... + z_i v_i`, the angular velocity of link i,
        `Jdot v = sum_i v_i [(w_i + w_(i-1)) x l_i; w_i x z_i]`.
        """
        states = self.bullet.getLinkStates(self.body, self.joints, computeForwardKinematics=1, **self._client)
        # Poses of the centres of mass: PyBullet gives the link frames in single precision only.
        turned = Rotation.from_quat([state[1] for state in states]).as_matrix() @ self._local
        axes, centers = turned[:, :, 0], turned[:, :, 1]
        origins = np.array([state[0] for state in states]) - centers
        position = origins[-1] + turned[-1, :, 2]

        columns = np.cross(axes, position - origins)
        own = axes * v[:, None]
        rotation = np.cumsum(own, axis=0)
        jacobian = np.concatenate([columns, axes], axis=1).T
        rates = np.concatenate([np.cross(2.0 * rotation - own, columns), np.cross(rotation, axes)], axis=1).T
        return position, np.array(states[-1][1]), jacobian, rates @ v

    def step(self, torques: Float[np.ndarray, " nv"]) -> None:
        """Advance by one time step under joint torques [Nm]. Raises SimulationError if they are not finite."""
        if not np.isfinite(torques).all():
            raise SimulationError("the torques are not finite; the simulated motion has diverged.")
        how = {"forces": torques.tolist(), **self._client}
        self.bullet.setJointMotorControlArray(self.body, self.joints, self.bullet.TORQUE_CONTROL, **how)
        self.bullet.stepSimulation(**self._client)


@dataclass(frozen=True, eq=False)
class ArmState:
    """The arm before a step, with what its dynamics and its tool point are there (`BulletArm.tool`)."""

    q: Float[np.ndarray, " nv"]
    v: Float[np.ndarray, " nv"]
    mass: Float[np.ndarray, "nv nv"]
    bias: Float[np.ndarray, " nv"]
    position: Float[np.ndarray, "3"]
    quaternion: Float[np.ndarray, "4"]
    jacobian: Float[np.ndarray, "6 nv"]
    bias_acceleration: Float[np.ndarray, "6"]

    @staticmethod
    def of(arm: BulletArm, q: Float[np.ndarray, " nv"], v: Float[np.ndarray, " nv"]) -> "ArmState":
        """The present one, whose state is q, v."""
        return ArmState(q, v, arm.mass_matrix(q), arm.bias_forces(q, v), *arm.tool(v))


def _without_limits_and_damping(urdf: str) -> str:
    """The URDF with continuous joints and without damping: `changeDynamics` switches off neither once it is loaded."""
    root = ElementTree.fromstring(urdf)
    for joint in root.iter("joint"):
        if joint.get("type") == "revolute":
            joint.set("type", "continuous")
        for element in joint.findall("dynamics") + joint.findall("limit"):
            joint.remove(element)
    return ElementTree.tostring(root, encoding="unicode")


Heights = tuple[Float[np.ndarray, " times"], Float[np.ndarray, "times 2"], Float[np.ndarray, "times 2 2"]]
Aim = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]
Motions = tuple[Float[np.ndarray, "times 3"], Float[np.ndarray, "times 3"], Float[np.ndarray, "times 3"]]


def table_of(config: KukaSurfaceConfig) -> Plane | Sphere:
    """The table of a scenario; for `surface="none"` the plane that way-points keep above."""
    middle = np.array([np.mean(config.waypoint_x), np.mean(config.waypoint_y), config.surface_height])
    if config.surface == "sphere":
        x, y, z = (middle - (0.0, 0.0, config.sphere_radius)).tolist()
        return Sphere((x, y, z), config.sphere_radius)
    upward = np.array([0.0, 0.0, 1.0])
    if config.surface == "tilted":
        angle, (x, y) = np.deg2rad(config.tilt_degrees), np.array(config.tilt_axis) / np.hypot(*config.tilt_axis)
        # Rodrigues' formula for the vertical unit vector about the horizontal axis (x, y, 0).
        upward = np.array([y * np.sin(angle), -x * np.sin(angle), np.cos(angle)])
    x, y, z = upward.tolist()
    return Plane((x, y, z), float(upward @ middle))


def table_height(config: KukaSurfaceConfig, xy: Float[np.ndarray, "times 2"]) -> Heights:
    """Height [m] of the table above its middle, its gradient and its Hessian [1/m] in x and y."""
    table = table_of(config)
    if isinstance(table, Plane):
        *normal, upwards = table.normal
        slope = -np.array(normal) / upwards
        height = table.offset / upwards + xy @ slope
        return height - config.surface_height, np.broadcast_to(slope, xy.shape), np.zeros((len(xy), 2, 2))
    ray = xy - table.center[:2]
    rise = np.sqrt(table.radius**2 - (ray**2).sum(axis=1))
    gradient = -ray / rise[:, None]
    hessian = -(np.eye(2) + gradient[:, :, None] * gradient[:, None, :]) / rise[:, None, None]
    return rise - table.radius, gradient, hessian


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
        segment = np.clip(np.searchsorted(starts, time, side="right") - 1, 0, len(self.durations) - 1)
        duration, acceleration = self.durations[segment], self.accelerations[segment]
        step = np.diff(self.points, axis=0)
        length = np.linalg.norm(step, axis=1)
        direction = (step / np.where(length > 0, length, 1.0)[:, None])[segment]
        length = length[segment]

        root = np.sqrt(np.maximum((acceleration * duration) ** 2 - 4.0 * acceleration * length, 0.0))
        blend = 0.5 * duration - 0.5 * root / acceleration
        cruise = acceleration * blend
        inside = (time >= 0) & (time < starts[-1])
        elapsed = np.clip(time - starts[segment], 0.0, duration)
        left = duration - elapsed
        speeding, braking = elapsed < blend, left <= blend
        travelled = np.where(
            speeding,
            0.5 * acceleration * elapsed**2,
            np.where(braking, length - 0.5 * acceleration * left**2, cruise * (elapsed - 0.5 * blend)),
        )
        speed = np.where(speeding, acceleration * elapsed, np.where(braking, acceleration * left, cruise))
        change = np.where(speeding, acceleration, np.where(braking & (blend > 0), -acceleration, 0.0))
        return (
            self.points[segment] + direction * travelled[:, None],
            direction * np.where(inside, speed, 0.0)[:, None],
            direction * np.where(inside, change, 0.0)[:, None],
        )


def over_table(config: KukaSurfaceConfig, motions: Motions) -> Motions:
    """Motions over a horizontal table, bent to follow its true height `h(x, y)`: z and h by the chain rule."""
    position, velocity, acceleration = motions
    height, gradient, hessian = table_height(config, position[:, :2])
    rate = np.einsum("ti,ti->t", gradient, velocity[:, :2])
    bend = np.einsum("ti,tij,tj->t", velocity[:, :2], hessian, velocity[:, :2])
    position[:, 2] += height
    velocity[:, 2] += rate
    acceleration[:, 2] += np.einsum("ti,ti->t", gradient, acceleration[:, :2]) + bend
    return position, velocity, acceleration


def random_path(
    config: KukaSurfaceConfig, start: Float[np.ndarray, "3"], seconds: float, rng: np.random.Generator
) -> SegmentPath:
    """Random way-points at `config.waypoint_height`, from `start` [m], for at least `seconds` [s]."""
    points, durations = [np.asarray(start, dtype=np.float64)], []
    while sum(durations) < seconds:
        durations.append(rng.uniform(*config.segment_seconds))
        x, y = rng.uniform(*config.waypoint_x), rng.uniform(*config.waypoint_y)
        points.append(np.array([x, y, config.waypoint_height]))
    corners, times = np.array(points), np.array(durations)
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    accelerations = np.maximum(config.least_acceleration, 4.0 * lengths / times**2)
    return SegmentPath(corners, times, accelerations)


TOOL_ORIENTATION = np.array([0.0, -1.0, 0.0, 0.0])  # quaternion (x, y, z, w): the tool points straight down


def joint_acceleration(config: KukaSurfaceConfig, state: ArmState, reference: Aim) -> Float[np.ndarray, " nv"]:
    """Commanded joint acceleration [rad/s^2] under which the tool follows an aimed position, velocity and acceleration.

    Resolved-acceleration control (Siciliano et al., Robotics, section 8.6.2) with a null-space posture: with `e` the
    error of the tool (translation; rotation vector),
    `J^+ (x_ref'' + 2 zeta omega e' + omega^2 e - Jdot v) + (I - J^+ J) S (K (q_0 - q) - D v)`; `S` selects joints.
    """
    aim, aim_velocity, aim_acceleration = reference
    omega, gain = config.controller_omega, 2.0 * config.controller_zeta * config.controller_omega
    jacobian, task = state.jacobian, np.empty(6)
    velocity = jacobian @ state.v
    turn = (Rotation.from_quat(TOOL_ORIENTATION) * Rotation.from_quat(state.quaternion).inv()).as_rotvec()
    task[:3] = aim_acceleration + gain * (aim_velocity - velocity[:3]) + omega**2 * (aim - state.position)
    task[3:] = -gain * velocity[3:] + omega**2 * turn
    pull = config.null_space_stiffness * (np.deg2rad(config.start_degrees) - state.q)
    selected = np.isin(np.arange(1, 8), config.null_space_joints).astype(np.float64)
    posture = selected * (pull - config.null_space_damping * state.v)
    # J^+ (task - Jdot v) + (I - J^+ J) posture, with J^+ = J^T (J J^T)^-1
    residual = task - state.bias_acceleration - jacobian @ posture
    return posture + jacobian.T @ np.linalg.solve(jacobian @ jacobian.T, residual)


RATE = 240
"""Rows per second."""


def recorded(
    scenario: str,
    config: Any,
    model: Model,
    motion: Mapping[str, np.ndarray],
    truth: Mapping[str, np.ndarray],
    metadata: Mapping[str, Any] | None = None,
) -> Dataset:
    """Rows of `config.episodes` episodes of equal length: q, v, u and the true a of `motion`, which gets its noise.

    The noise has a stream of its own for each episode, so that it leaves the motion of a seed as it is. Rows are
    1 / RATE apart, unless `motion` has their time.
    """
    nv, steps = model.robot.nv, len(motion["a"]) // config.episodes
    streams = [np.random.default_rng([config.seed, episode, 1]) for episode in range(config.episodes)]
    noise = np.concatenate([stream.standard_normal((steps, nv)) for stream in streams])
    return Dataset(
        **{
            "time": np.tile(np.arange(steps) / RATE, config.episodes),
            **motion,
            "a": motion["a"] + config.noise * noise,
        },
        episode=np.repeat(np.arange(config.episodes), steps),
        model=model,
        noise_std=np.full(nv, config.noise) if config.noise > 0 else None,
        truth={"a": motion["a"], **truth},
        metadata={
            **{"scenario": scenario, "config": dataclasses.asdict(config), "versions": {"forcegp": __version__}},
            **(metadata or {}),
        },
    )
