"""Scenarios by name, and every number of them. Loads no library: a command line lists the options at once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import Any, ClassVar, Literal, get_args

import forcegp.data
from forcegp.errors import InvalidInput, require_known, require_number, usable_arguments

Range = tuple[str, float, float]
"""What is allowed in words, the least and the largest value."""

Numbers = tuple[float, ...]

SECONDS: Range = ("from 0.1 to 1e5 s", 0.1, 1e5)
POSITIVE: Range = ("finite and > 0", 1e-12, 1e9)
NOT_NEGATIVE: Range = ("finite and >= 0", 0.0, 1e9)


def require_joint_friction(name: Any) -> None:
    """Raise InvalidInput for what is neither none nor laws of joints."""
    if name == "none":
        return
    from forcegp.forces.joint_law import JointLaw  # torch, which lists of options do without
    from forcegp.forces.registry import parse_forces

    try:
        laws = parse_forces(name)
    except InvalidInput as error:
        raise InvalidInput(f"joint_friction: {error}") from None
    if not all(isinstance(law, JointLaw) for law in laws):
        raise InvalidInput(f"joint_friction is {name!r}; give laws of joints such as viscous,stribeck, or none.")


Surface = Literal["plane", "tilted", "none"]

PRESS_FOR_DRY_FRICTION = 15.0  # N


@dataclass(frozen=True, kw_only=True)
class CommonConfig:
    """What every scenario has: recorded seconds of each episode, and the noise of the acceleration."""

    seconds: float = 60.0
    seed: int = 0
    noise: float = 0.1
    episodes: int = 1

    def _check(self, **ranges: Range) -> None:
        """Raise InvalidInput for these numbers, and those that have one of the ranges."""
        for name, (words, lower, upper) in {"seconds": SECONDS, "noise": NOT_NEGATIVE, **ranges}.items():
            most = math.nextafter(upper, math.inf)
            require_number(name, getattr(self, name), f"it must be one number, {words}", lower, most)
            object.__setattr__(self, name, float(getattr(self, name)))
        for name, least, most in (("seed", 0, 2**63 - 1), ("episodes", 1, 10_000)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise InvalidInput(f"{name} is {value!r}; it must be an integer from {least} to {most}.")


@dataclass(frozen=True, kw_only=True)
class KukaSurfaceConfig(CommonConfig):
    """A KUKA LBR iiwa 14 slides its tool on a surface; friction is the force nobody models.

    By default a plane and viscous friction at the tool point, as in Rath, Geist, Trimpe 2021, section 5, with the
    constants of their reference implementation. SI units and radians unless a name has another unit. `seconds` are
    recorded after `settle_seconds`; `seed` draws way-points and noise from separate streams, so that another `noise`
    leaves the motion as it is. Raises InvalidInput naming the field and its allowed range.
    """

    seconds: float = 200.0
    time_step: float = 1.0 / 240.0  # s, of simulation, control and recording
    settle_seconds: float = 1000.0 / 240.0  # approach and first contact, left out as in the paper (its first 1000 rows)
    tool_mass: float = 2.0  # kg, of link 7 with its tool
    # the plane z = surface_height; it tilted about the middle of the way-points' region; or none: free motion above.
    # The contact is a bilateral constraint from the first touch on
    surface: Surface = "plane"
    # of the tool on the surface, the force that no model contains: viscous; or a law of dry friction of
    # `forcegp.forces` by name, which grows with the normal force, and near rest where it has a breakaway
    friction: str = "viscous"
    viscous_coefficient: float = 1.0  # of the tool point on the surface [N/(m/s)]
    coulomb_coefficient: float = 0.3  # dry friction of the sliding tool per normal force
    static_coefficient: float = 0.5  # near rest, of laws with a breakaway
    breakaway_velocity: float = 0.15  # m/s, over which the static coefficient falls to the sliding one
    # m/s, below which dry friction of the tool falls to zero: a smooth sign. The explicit steps oscillate where
    # `static_coefficient * normal force / friction_smoothing` exceeds some 450 N/(m/s)
    friction_smoothing: float = 0.05
    # of the joints, besides the force at the tool and not part of `u`: viscous friction and laws of `forcegp.forces`,
    # such as "coulomb", with their own numbers (`parse_forces`) or those below
    joint_friction: str = "none"
    joint_breakaway_velocity: float = 0.2  # rad/s, over which the friction near rest falls to Coulomb's
    joint_smoothing: float = 0.1  # rad/s, below which it falls to zero: a smooth sign

    # The constants of the scene, which nobody has to choose.
    gravity: ClassVar[float] = 9.8  # along -z
    tool_point: ClassVar[tuple[float, float, float]] = (0.0, 0.0, 0.1)  # that touches the surface, in the link-7 frame
    tool_center_of_mass: ClassVar[Numbers] = (0.0, 0.0, 0.02)  # of link 7
    tool_inertia: ClassVar[Numbers] = (0.005, 0.0036, 0.0047)  # its principal moments about that
    joint_damping: ClassVar[float] = 0.5  # of every joint; subtracted from the commanded torque in the recorded u
    surface_height: ClassVar[float] = 0.055  # in the middle of the way-points' region
    tilt_degrees: ClassVar[float] = 10.0  # of the tilted plane, about a horizontal axis (x, y)
    tilt_axis: ClassVar[tuple[float, float]] = (0.0, 1.0)
    joint_coulomb: ClassVar[Numbers] = (2.0, 2.0, 1.3, 1.3, 0.12, 0.12, 0.05)  # small where explicit steps oscillate
    joint_static: ClassVar[Numbers] = (3.0, 3.0, 2.0, 2.0, 0.2, 0.2, 0.08)  # near rest
    joint_viscous: ClassVar[Numbers] = (1.0, 1.0, 0.5, 0.5, 0.05, 0.05, 0.02)  # beyond `joint_damping`
    baumgarte_omega: ClassVar[float] = 10.0
    baumgarte_zeta: ClassVar[float] = 1.0
    start_degrees: ClassVar[Numbers] = (85, 50, -10, -100, -170, -25, -100)  # also the posture of the null space
    torque_limits: ClassVar[Numbers] = (320, 320, 176, 176, 110, 40, 40)  # that the controller commands
    controller_omega: ClassVar[float] = 100.0  # of the tool's tracking error, critically damped
    controller_zeta: ClassVar[float] = 1.0
    null_space_joints: ClassVar[tuple[int, ...]] = (2, 3, 5)  # 1 to 7, held near the start posture
    null_space_stiffness: ClassVar[float] = 1e4
    null_space_damping: ClassVar[float] = 100.0
    waypoint_x: ClassVar[tuple[float, float]] = (-0.5, 0.5)  # ranges of random way-points
    waypoint_y: ClassVar[tuple[float, float]] = (0.4, 0.6)
    waypoint_depth: ClassVar[float] = 1e-4  # below the surface, so that the tool presses on it
    clearance: ClassVar[float] = 0.05  # above the plane where there is no surface
    segment_seconds: ClassVar[tuple[float, float]] = (0.5, 1.0)  # from one way-point to the next
    least_acceleration: ClassVar[float] = 0.5  # in the parabolic blends, unless a segment needs more

    @usable_arguments("KukaSurfaceConfig")
    def __post_init__(self) -> None:
        self._check(**_RANGES)
        require_known("surface", self.surface, "kuka-surface", get_args(Surface))
        if self.friction != "viscous":
            from forcegp.forces.registry import dry_laws

            require_known("friction", self.friction, "the tool", ("viscous", *dry_laws()))
        require_joint_friction(self.joint_friction)

    @property
    def pressing_force(self) -> float:
        """Force towards the surface that the controller adds [N]: dry friction needs a normal force."""
        return 0.0 if self.surface == "none" or self.friction == "viscous" else PRESS_FOR_DRY_FRICTION

    @property
    def waypoint_height(self) -> float:
        """Height of way-points in the middle of their region [m], which follow the surface elsewhere."""
        return self.surface_height + (self.clearance if self.surface == "none" else -self.waypoint_depth)

    @property
    def rows_per_episode(self) -> int:
        """Recorded rows of one episode."""
        return round(self.seconds / self.time_step)

    @property
    def settle_steps(self) -> int:
        """Steps before the first recorded row."""
        return math.ceil(self.settle_seconds / self.time_step - 1e-9)


_POSITIVE = ("tool_mass", "breakaway_velocity", "friction_smoothing", "joint_breakaway_velocity", "joint_smoothing")
_RANGES: dict[str, Range] = {
    "time_step": ("from 1e-5 to 0.01 s", 1e-5, 0.01),
    "settle_seconds": ("from 0.5 to 1000 s", 0.5, 1e3),
    **dict.fromkeys(_POSITIVE, POSITIVE),
    **dict.fromkeys(("viscous_coefficient", "coulomb_coefficient", "static_coefficient"), NOT_NEGATIVE),
}


@dataclass(frozen=True, kw_only=True)
class QuadrupedConfig(CommonConfig):
    """A robot that stands, shifts its weight and lifts its feet; `payload` in kg on its trunk is in no robot file.

    With `lift` each foot in turn leaves the ground for a second. `joint_friction` names laws of `forcegp.forces`, or
    "none", equal in all joints; viscous friction comes with them.
    `noise` in rad/s^2 and m/s^2. Raises InvalidInput naming the field and its range.
    """

    seconds: float = 30.0
    payload: float = 2.0
    lift: bool = True
    joint_friction: str = "stribeck"

    @usable_arguments("QuadrupedConfig")
    def __post_init__(self) -> None:
        self._check(payload=NOT_NEGATIVE)
        require_joint_friction(self.joint_friction)


@dataclass(frozen=True, kw_only=True)
class QuadrotorConfig(CommonConfig):
    """A drone that follows a path in `wind` [m/s] from a random side, with gusts; rotors follow within `lag` [s].

    `seed` draws path, side and gusts; the drone is always the same. `noise` in rad/s^2 and m/s^2. Raises InvalidInput.
    """

    wind: float = 4.0
    lag: float = 0.06

    @usable_arguments("QuadrotorConfig")
    def __post_init__(self) -> None:
        self._check(wind=("from 0 to 15 m/s", 0.0, 15.0), lag=("from 0.005 to 0.2 s", 0.005, 0.2))


SCENARIOS: Mapping[str, tuple[type, str]] = MappingProxyType(
    {
        "kuka-surface": (KukaSurfaceConfig, "kuka_surface:simulate_kuka_surface"),
        "quadruped": (QuadrupedConfig, "moving_bases:simulate_quadruped"),
        "quadrotor": (QuadrotorConfig, "moving_bases:simulate_quadrotor"),
    }
)
"""Name -> the frozen dataclass of all its numbers, and "module:name" of a function `(config) -> Dataset`."""


def simulate(scenario: str, **numbers: Any) -> forcegp.data.Dataset:
    """Run a scenario by name with these fields of its config.

    Libraries are imported here, so that listing scenarios is quick. Raises InvalidInput for numbers out of range.
    """
    require_known("scenario", scenario, "forcegp simulate", SCENARIOS)
    config, function = SCENARIOS[scenario]
    module, _, name = function.partition(":")
    return getattr(import_module(f"forcegp.simulation.{module}"), name)(config(**numbers))
