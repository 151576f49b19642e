"""A fixed-base arm in PyBullet without a window: its state, its dynamics as PyBullet computes them, and steps."""

import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from forcegp.errors import MissingExtra, SimulationError


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
        turned = _rotation_matrices([state[1] for state in states]) @ self._local
        axes, centers = turned[:, :, 0], turned[:, :, 1]
        origins = np.array([state[0] for state in states]) - centers
        position = origins[-1] + turned[-1, :, 2]

        columns = _cross(axes, position - origins)
        own = axes * v[:, None]
        rotation = np.cumsum(own, axis=0)
        jacobian = np.concatenate([columns, axes], axis=1).T
        rates = np.concatenate([_cross(2.0 * rotation - own, columns), _cross(rotation, axes)], axis=1).T
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
    def of(arm: BulletArm) -> "ArmState":
        """The present one."""
        q, v = arm.state()
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


_NEXT, _AFTER_NEXT = np.array([1, 2, 0]), np.array([2, 0, 1])


def _cross(a: Float[np.ndarray, "rows 3"], b: Float[np.ndarray, "rows 3"]) -> Float[np.ndarray, "rows 3"]:
    """Row-wise cross product; np.cross costs several times as much for a few rows."""
    forward = a.take(_NEXT, axis=1) * b.take(_AFTER_NEXT, axis=1)
    return forward - a.take(_AFTER_NEXT, axis=1) * b.take(_NEXT, axis=1)


def _rotation_matrices(quaternions: Sequence[tuple[float, ...]]) -> Float[np.ndarray, "rows 3 3"]:
    """Rotation matrices of unit quaternions (x, y, z, w)."""
    return np.array(
        [
            (
                (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
                (2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)),
                (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)),
            )
            for x, y, z, w in quaternions
        ]
    )
