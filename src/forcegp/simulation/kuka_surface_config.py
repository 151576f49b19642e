"""Every number of the `kuka-surface` scenario. Loads no library: a command line lists the options at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from forcegp.errors import InvalidInput


@dataclass(frozen=True, kw_only=True)
class KukaSurfaceConfig:
    """A KUKA LBR iiwa 14 slides its tool on a plane; viscous friction at the tool point is the force nobody models.

    Rath, Geist, Trimpe 2021, section 5, with the constants of their reference implementation. SI units and radians
    unless a name says otherwise. Raises InvalidInput naming the field and its allowed range.
    """

    # This constructor is the check, with messages for people; run-time checks of annotations must not come before it.
    __no_type_check__: ClassVar[bool] = True

    seconds: float = 200.0
    """Recorded time of each episode [s]; `settle_seconds` are simulated before it and not recorded."""
    seed: int = 0
    """Draws way-points and noise, from separate streams: another `noise` leaves the motion as it is."""
    noise: float = 0.1
    """Standard deviation of the Gaussian noise on the acceleration [rad/s^2]; 0 for none."""
    episodes: int = 1
    """Number of independent trajectories, each from the start posture and with its own way-points."""

    time_step: float = 1.0 / 240.0
    """Step of simulation, control and recording [s]."""
    settle_seconds: float = 1000.0 / 240.0
    """Approach and first contact [s], left out of the data as in the paper (its first 1000 rows)."""
    gravity: float = 9.8
    """Along -z [m/s^2]."""
    base_height: float = 0.05
    """Height of the robot's base above the origin [m]."""

    tool_mass: float = 2.0
    """Mass of link 7 with its tool [kg]."""
    tool_center_of_mass: tuple[float, float, float] = (0.0, 0.0, 0.02)
    """In the link-7 frame [m]."""
    tool_inertia: tuple[float, float, float] = (0.005, 0.0036, 0.0047)
    """Principal moments of inertia of link 7 about its centre of mass [kg m^2]."""
    tool_point: tuple[float, float, float] = (0.0, 0.0, 0.1)
    """The point that touches the surface, in the link-7 frame [m]."""
    joint_damping: float = 0.5
    """Viscous friction of every joint [Nms/rad]; subtracted from the commanded torque in the recorded `u`."""

    surface_height: float = 0.055
    """The surface is the plane z = surface_height [m], an ideal bilateral constraint from the first touch on."""
    friction: float = 1.0
    """Viscous friction of the tool point on the surface [N/(m/s)], the force that no model knows."""
    baumgarte_omega: float = 10.0
    """Natural frequency of the constraint's stabilisation [rad/s]."""
    baumgarte_zeta: float = 1.0
    """Damping ratio of the constraint's stabilisation."""

    start_degrees: tuple[float, float, float, float, float, float, float] = (85, 50, -10, -100, -170, -25, -100)
    """Joint positions at the start of an episode [deg]; also the posture that the null space holds."""
    torque_limits: tuple[float, float, float, float, float, float, float] = (320, 320, 176, 176, 110, 40, 40)
    """Largest torque that the controller commands [Nm]."""
    controller_omega: float = 100.0
    """Natural frequency of the tool's tracking error, translation and rotation [rad/s]."""
    controller_zeta: float = 1.0
    """Damping ratio of the tool's tracking error."""
    null_space_joints: tuple[int, ...] = (2, 3, 5)
    """Joints (1 to 7) that the null space holds near the start posture."""
    null_space_stiffness: float = 1e4
    """Acceleration per position error in the null space [1/s^2]."""
    null_space_damping: float = 100.0
    """Deceleration per velocity in the null space [1/s]."""

    waypoint_x: tuple[float, float] = (-0.5, 0.5)
    """Range of random way-points [m]."""
    waypoint_y: tuple[float, float] = (0.4, 0.6)
    """Range of random way-points [m]."""
    waypoint_depth: float = 1e-4
    """How far below the surface the way-points lie, so that the tool presses on it [m]."""
    segment_seconds: tuple[float, float] = (0.5, 1.0)
    """Range of the random time from one way-point to the next [s]."""
    least_acceleration: float = 0.5
    """Acceleration in the parabolic blends, unless a segment needs more to arrive in time [m/s^2]."""

    def __post_init__(self) -> None:
        for name, (allowed, lower, upper) in _RANGES.items():
            object.__setattr__(self, name, _numbers(name, getattr(self, name), allowed, lower, upper))
        for name in ("waypoint_x", "waypoint_y", "segment_seconds"):
            first, second = getattr(self, name)
            if first > second:
                raise InvalidInput(f"{name} is ({first}, {second}); the first must not exceed the second.")
        _require_integer("seed", self.seed, 0, 2**63 - 1)
        _require_integer("episodes", self.episodes, 1, 10_000)
        object.__setattr__(self, "null_space_joints", tuple(self.null_space_joints))
        for joint in self.null_space_joints:
            _require_integer("null_space_joints", joint, 1, 7)

    @property
    def rows_per_episode(self) -> int:
        """Recorded rows of one episode."""
        return round(self.seconds / self.time_step)

    @property
    def settle_steps(self) -> int:
        """Steps before the first recorded row."""
        return math.ceil(self.settle_seconds / self.time_step - 1e-9)

    @property
    def steps(self) -> int:
        """Simulated steps of all episodes together."""
        return self.episodes * (self.settle_steps + self.rows_per_episode)


_POSITIVE = ("finite and > 0", 1e-12, 1e9)
_NOT_NEGATIVE = ("finite and >= 0", 0.0, 1e9)
_FINITE = ("finite", -1e9, 1e9)
_RANGES = {
    "seconds": ("from 0.1 to 1e5 s", 0.1, 1e5),
    "noise": _NOT_NEGATIVE,
    "time_step": ("from 1e-5 to 0.01 s", 1e-5, 0.01),
    "settle_seconds": ("from 0.5 to 1000 s", 0.5, 1e3),
    "gravity": _FINITE,
    "base_height": _FINITE,
    "tool_mass": _POSITIVE,
    "tool_center_of_mass": _FINITE,
    "tool_inertia": _POSITIVE,
    "tool_point": _FINITE,
    "joint_damping": _NOT_NEGATIVE,
    "surface_height": _FINITE,
    "friction": _NOT_NEGATIVE,
    "baumgarte_omega": _NOT_NEGATIVE,
    "baumgarte_zeta": _NOT_NEGATIVE,
    "start_degrees": _FINITE,
    "torque_limits": _POSITIVE,
    "controller_omega": _POSITIVE,
    "controller_zeta": _NOT_NEGATIVE,
    "null_space_stiffness": _NOT_NEGATIVE,
    "null_space_damping": _NOT_NEGATIVE,
    "waypoint_x": _FINITE,
    "waypoint_y": _FINITE,
    "waypoint_depth": _NOT_NEGATIVE,
    "segment_seconds": ("from 0.05 to 100 s", 0.05, 100.0),
    "least_acceleration": _POSITIVE,
}
_LENGTHS = {
    "tool_center_of_mass": 3,
    "tool_inertia": 3,
    "tool_point": 3,
    "start_degrees": 7,
    "torque_limits": 7,
    "waypoint_x": 2,
    "waypoint_y": 2,
    "segment_seconds": 2,
}


def _numbers(name: str, value: Any, allowed: str, lower: float, upper: float) -> float | tuple[float, ...]:
    """The value as float, or as a tuple of floats where the field has several."""
    length = _LENGTHS.get(name)
    values = tuple(value) if isinstance(value, tuple | list) else (value,)
    if len(values) != (length or 1) or isinstance(value, tuple | list) != (length is not None):
        raise InvalidInput(
            f"{name} is {value!r}; it must be {f'{length} numbers' if length else 'one number'}, {allowed}."
        )
    for number in values:
        valid = isinstance(number, int | float) and not isinstance(number, bool)
        if not valid or not lower <= number <= upper:  # NaN fails every comparison
            raise InvalidInput(f"{name} is {value!r}; it must be {allowed}.")
    return tuple(float(number) for number in values) if length else float(values[0])


def _require_integer(name: str, value: Any, lower: int, upper: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not lower <= value <= upper:
        raise InvalidInput(f"{name} is {value!r}; it must be an integer from {lower} to {upper}.")
