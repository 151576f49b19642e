"""The `kuka-surface` scenario: an iiwa slides its tool on a surface with friction (after Rath, Geist, Trimpe 2021)."""

from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from forcegp import __version__
from forcegp.data import Dataset
from forcegp.errors import SimulationError
from forcegp.forces import Actuation, RigidBodies
from forcegp.mechanics import Baumgarte, Contact
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.simulation.kuka_motion import TOOL_LINK, Motion, kuka_urdf, simulate_episode
from forcegp.simulation.recording import recorded
from forcegp.simulation.scenarios import KukaSurfaceConfig
from forcegp.simulation.trajectory import table_of

Progress = Callable[[int, int], None]
"""Called as `progress(steps done, steps in total)`."""

LARGEST_GAP = 5e-3  # m between tool and surface; the integrator's drift is below 1 mm
LARGEST_LIMIT_EXCESS = np.deg2rad(1.0)  # the start posture itself lies on the limit of joint 5
LARGEST_SATURATED_SHARE = 0.01


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
    urdf = kuka_urdf(config)
    robot = Robot.from_urdf_text(urdf, source="kuka-surface", gravity=(0.0, 0.0, -config.gravity))
    motions = []
    for episode in range(config.episodes):

        def report(step: int, done: int = episode * config.steps // config.episodes) -> None:
            if progress is not None:
                progress(done + step, config.steps)

        motion = simulate_episode(config, robot, urdf, episode, report)
        _require_useful(config, robot, motion, episode)
        motions.append(motion)
    return _dataset(config, robot, motions)


def _require_useful(config: KukaSurfaceConfig, robot: Robot, motion: Motion, episode: int) -> None:
    """Refuse rows that an ideal robot on an ideal plane would not give."""
    remedy = "Use the published constants, or slower segments (segment_seconds) and way-points within reach."
    gap = float(np.abs(motion.gap).max())
    if config.surface != "none" and config.contact == "ideal" and not gap < LARGEST_GAP:
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


def _model(config: KukaSurfaceConfig, robot: Robot) -> Model:
    contacts = ()
    if config.surface != "none":
        contacts = (Contact(TOOL_LINK, config.tool_point, table_of(config).surface()),)
    # PyBullet's contact does not follow Baumgarte's law.
    stabilised = contacts and config.contact == "ideal"
    return Model(
        robot=robot,
        contacts=contacts,
        forces=(Actuation(), RigidBodies()),
        baumgarte=Baumgarte(config.baumgarte_omega, config.baumgarte_zeta) if stabilised else None,
    )


def _truth(config: KukaSurfaceConfig, column: Callable[[str], np.ndarray]) -> dict[str, np.ndarray]:
    """Every true force of the rows, as far as it exists."""
    truth, parts = {"a": column("a")}, {}
    if config.surface != "none":
        truth["lambda"] = column("multiplier")[:, None]
        parts["Q_U.tool-friction"] = column("tool_torques")
        truth["force.tool-friction"] = column("tool_force")
    if config.contact == "bullet":
        truth["in_contact"] = column("in_contact")[:, None].astype(np.float64)
    if config.joint_friction != "none":
        parts["Q_U.joint-friction"] = column("joint_torques")
    return {**truth, **parts, "Q_U": sum(parts.values(), np.zeros_like(truth["a"]))}


def _dataset(config: KukaSurfaceConfig, robot: Robot, motions: list[Motion]) -> Dataset:
    def column(name: str) -> np.ndarray:
        return np.concatenate([getattr(motion, name) for motion in motions])

    signals = {name: column(name) for name in ("q", "v", "u", "a", "time")}
    versions = {"forcegp": __version__, "pybullet": _pybullet_version(), "numpy": np.__version__}
    more = {"u": "commanded torque minus joint damping", "versions": versions}
    return recorded("kuka-surface", config, _model(config, robot), signals, _truth(config, column), more)


def _pybullet_version() -> str:
    try:
        return version("pybullet")
    except PackageNotFoundError:  # built from source without package metadata
        return "unknown"
