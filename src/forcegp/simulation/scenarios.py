"""Scenarios by name, and every number of them. Loads no library: a command line lists the options at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from importlib import import_module
from types import MappingProxyType
from typing import Any, Literal, get_args

import forcegp.data
from forcegp.errors import InvalidInput, require_known, usable_arguments

Range = tuple[str, float, float]
"""What is allowed in words, the least and the largest value."""

POSITIVE: Range = ("finite and > 0", 1e-12, 1e9)
NOT_NEGATIVE: Range = ("finite and >= 0", 0.0, 1e9)
FINITE: Range = ("finite", -1e9, 1e9)


def checked_numbers(name: str, value: Any, allowed: Range, length: int | None) -> float | tuple[float, ...]:
    """The value as float, or as a tuple of `length` floats. Raises InvalidInput naming the field and its range."""
    words, lower, upper = allowed
    values = tuple(value) if isinstance(value, tuple | list) else (value,)
    if len(values) != (length or 1) or isinstance(value, tuple | list) != (length is not None):
        raise InvalidInput(
            f"{name} is {value!r}; it must be {f'{length} numbers' if length else 'one number'}, {words}."
        )
    for number in values:
        valid = isinstance(number, int | float) and not isinstance(number, bool)
        if not valid or not lower <= number <= upper:  # NaN fails every comparison
            raise InvalidInput(f"{name} is {value!r}; it must be {words}.")
    return tuple(float(number) for number in values) if length else float(values[0])


def require_integer(name: str, value: Any, lower: int, upper: int) -> None:
    """Raise InvalidInput naming the field for anything else than an integer in the range."""
    if isinstance(value, bool) or not isinstance(value, int) or not lower <= value <= upper:
        raise InvalidInput(f"{name} is {value!r}; it must be an integer from {lower} to {upper}.")


def require_joint_friction(name: Any, more: Sequence[str] = ()) -> None:
    """Raise InvalidInput for what is neither none, nor one of these, nor laws of joints."""
    if name in ("none", *more):
        return
    from forcegp.forces.force import JointLaw  # torch, which lists of options do without
    from forcegp.forces.registry import FORCES, force_class, parse_forces

    try:
        known = isinstance(name, str) and all(isinstance(law, JointLaw) for law in parse_forces(name))
    except InvalidInput as error:
        raise InvalidInput(f"joint_friction is {name!r}: {error}") from None
    if not known:
        laws = (each for each in FORCES if issubclass(force_class(each), JointLaw))
        raise InvalidInput(f"joint_friction is {name!r}; give one of {', '.join(('none', *more, *laws))}.")


def usual_dry_friction(config: Any) -> None:
    """Put the law that most joints need in the place of None, and check others."""
    if config.joint_friction is None:
        from forcegp.forces.registry import USUAL_DRY

        object.__setattr__(config, "joint_friction", USUAL_DRY)
    require_joint_friction(config.joint_friction)


OF_PLANTS = ("exponential", "asymmetric", "load", "lugre", "drift")
"""Joint friction that no model has (`JointFrictionLaw`)."""
Surface = Literal["plane", "tilted", "sphere", "none"]
ContactKind = Literal["ideal", "bullet"]

PRESS_FOR_DRY_FRICTION = 15.0  # N
LIFT_SHARE_OF_BULLET = 0.08


@dataclass(frozen=True, kw_only=True)
class KukaSurfaceConfig:
    """A KUKA LBR iiwa 14 slides its tool on a surface; friction is the force nobody models.

    By default a plane and viscous friction at the tool point, as in Rath, Geist, Trimpe 2021, section 5, with the
    constants of their reference implementation. SI units and radians unless a name has another unit. Raises
    InvalidInput naming the field and its allowed range.
    """

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

    surface: Surface = "plane"
    """The plane z = surface_height; that plane tilted about the middle of the way-points' region; the top of a big
    sphere that touches it there; or none: free motion above."""
    surface_height: float = 0.055
    """Height of the surface in the middle of the way-points' region [m]."""
    tilt_degrees: float = 10.0
    """Angle of the tilted plane [deg]."""
    tilt_axis: tuple[float, float] = (0.0, 1.0)
    """Horizontal axis (x, y) about which it is tilted, right-handed."""
    sphere_radius: float = 1.2
    """Radius of the sphere [m]."""
    clearance: float = 0.05
    """How far above the plane the way-points lie where there is no surface [m]."""
    contact: ContactKind = "ideal"
    """ideal: a bilateral constraint from the first touch on. bullet: PyBullet's unilateral contact with Coulomb
    friction, without restitution, which the tool leaves now and then."""

    friction: str | None = None
    """Friction of the tool on the surface, the force that no model contains: viscous; or a law of dry friction of
    `forcegp.forces` by name, which grows with the normal force, and near rest where it has a breakaway. None is viscous
    for an ideal contact and coulomb, its only law, for PyBullet's."""
    viscous_coefficient: float = 1.0
    """Viscous friction of the tool point on the surface [N/(m/s)]."""
    coulomb_coefficient: float = 0.3
    """Dry friction of the sliding tool per normal force."""
    static_coefficient: float = 0.5
    """Dry friction near rest per normal force, of laws with a breakaway."""
    breakaway_velocity: float = 0.15
    """Speed over which the static coefficient falls to the sliding one [m/s]."""
    friction_smoothing: float = 0.05
    """Speed below which dry friction of the tool falls to zero [m/s]: a smooth sign, see `DryFriction`. The explicit
    steps oscillate where `static_coefficient * normal force * patch_factor / friction_smoothing` exceeds some
    450 N/(m/s), as on a patch of factor 4."""
    patch_factor: float = 1.0
    """How many times as large friction is on the patch; 1 for no patch."""
    patch_x: tuple[float, float] = (0.0, 0.25)
    """The patch is the strip of the surface with x in this range [m]."""
    joint_friction: str = "none"
    """Friction of the joints that is not part of `u`, besides the force at the tool: viscous friction and laws of
    `forcegp.forces`, such as "coulomb", with their own numbers (`forcegp.forces.parse_forces`) or those below; or one
    that no model has: "exponential" (more near rest), "asymmetric" (another force backwards, a hard sign), "load",
    "lugre" (bristles that yield before they slide) or "drift" (`JointFrictionLaw`)."""
    joint_coulomb: tuple[float, float, float, float, float, float, float] = (2.0, 2.0, 1.3, 1.3, 0.12, 0.12, 0.05)
    """Coulomb friction of every joint [Nm]; small in the wrist, whose inertia carries no motors here: explicit steps
    would oscillate under more."""
    joint_static: tuple[float, float, float, float, float, float, float] = (3.0, 3.0, 2.0, 2.0, 0.2, 0.2, 0.08)
    """Friction of every joint near rest [Nm], of laws with a breakaway, exponential and lugre."""
    joint_viscous: tuple[float, float, float, float, float, float, float] = (1.0, 1.0, 0.5, 0.5, 0.05, 0.05, 0.02)
    """Viscous friction of every joint [Nms/rad] beyond `joint_damping`."""
    joint_breakaway_velocity: float = 0.2
    """Joint velocity over which the friction near rest falls to Coulomb's [rad/s]."""
    joint_smoothing: float = 0.1
    """Joint velocity below which joint friction falls to zero [rad/s]: a smooth sign, see `JointFrictionLaw`."""
    joint_asymmetry: float = 0.7
    """Coulomb friction backwards over that forwards (asymmetric only)."""
    joint_load: tuple[float, float] = (0.04, 0.015)
    """Friction per applied torque of a joint that is driven, and of one that is driven back (load only)."""
    joint_presliding: float = 0.01
    """How far a joint gives before it slides [rad] (lugre only)."""
    joint_drift: tuple[float, float] = (0.3, 60.0)
    """Share of Coulomb friction that is lost as the gears warm up, and over how many seconds (drift only)."""
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
    press: float | None = None
    """Force along the surface's normal that the controller adds [N]; None is 0 for viscous friction and
    `PRESS_FOR_DRY_FRICTION` for the others, which need a normal force."""
    lift_share: float | None = None
    """Share of way-points that lie `lift_height` above the surface; None is `LIFT_SHARE_OF_BULLET` for PyBullet's
    contact and 0 for an ideal one, which cannot be left."""
    lift_height: float = 0.03
    """Height of those way-points [m]."""
    segment_seconds: tuple[float, float] = (0.5, 1.0)
    """Range of the random time from one way-point to the next [s]."""
    least_acceleration: float = 0.5
    """Acceleration in the parabolic blends, unless a segment needs more to arrive in time [m/s^2]."""

    @usable_arguments("KukaSurfaceConfig")
    def __post_init__(self) -> None:
        for name, allowed in _RANGES.items():
            value = getattr(self, name)
            if value is not None or name not in ("press", "lift_share"):
                object.__setattr__(self, name, checked_numbers(name, value, allowed, _LENGTHS.get(name)))
        for name in ("waypoint_x", "waypoint_y", "segment_seconds", "patch_x"):
            first, second = getattr(self, name)
            if first > second:
                raise InvalidInput(f"{name} is ({first}, {second}); the first must not exceed the second.")
        require_integer("seed", self.seed, 0, 2**63 - 1)
        require_integer("episodes", self.episodes, 1, 10_000)
        object.__setattr__(self, "null_space_joints", tuple(self.null_space_joints))
        for joint in self.null_space_joints:
            require_integer("null_space_joints", joint, 1, 7)
        if self.friction is None:
            object.__setattr__(self, "friction", "coulomb" if self.contact == "bullet" else "viscous")
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in get_args(choices):
                allowed = ", ".join(get_args(choices))
                raise InvalidInput(f"{name} is {getattr(self, name)!r}; it must be one of {allowed}.")
        if self.friction != "viscous":
            from forcegp.forces.registry import dry_laws

            require_known("friction", self.friction, "the tool", ("viscous", *dry_laws()))
        require_joint_friction(self.joint_friction, OF_PLANTS)
        self._require_parts_that_fit()

    def _require_parts_that_fit(self) -> None:
        if not any(self.tilt_axis):
            raise InvalidInput("tilt_axis is (0, 0); give a horizontal direction (x, y).")
        corner = 0.5 * math.hypot(*(upper - lower for lower, upper in (self.waypoint_x, self.waypoint_y)))
        if self.surface == "sphere" and self.sphere_radius < 1.5 * corner:
            raise InvalidInput(
                f"sphere_radius is {self.sphere_radius} m; it must be at least {1.5 * corner:.3g} m, one and a half "
                "times the distance from the middle of the way-points' region to its corners."
            )
        if self.contact == "bullet":
            if self.surface == "none":
                raise InvalidInput("surface is 'none'; contact 'bullet' needs a surface: plane, tilted or sphere.")
            if self.friction != "coulomb":
                raise InvalidInput(f"friction is {self.friction!r}; contact 'bullet' has Coulomb friction: 'coulomb'.")
        elif self.lift_share and self.surface != "none":
            raise InvalidInput(
                f"lift_share is {self.lift_share}; an ideal contact cannot be left. Use contact 'bullet', or 0."
            )
        if self.patch_factor != 1.0 and (self.contact == "bullet" or self.surface == "none"):
            raise InvalidInput(
                f"patch_factor is {self.patch_factor}; a patch needs a surface and an ideal contact (PyBullet has one "
                "coefficient for a whole body). Use 1, or surface plane, tilted or sphere and contact ideal."
            )

    @property
    def pressing_force(self) -> float:
        """Force towards the surface that the controller adds [N]."""
        usual = 0.0 if self.surface == "none" or self.friction == "viscous" else PRESS_FOR_DRY_FRICTION
        return usual if self.press is None or self.surface == "none" else self.press

    @property
    def waypoint_height(self) -> float:
        """Height of way-points in the middle of their region [m], which follow the surface elsewhere."""
        return self.surface_height + (self.clearance if self.surface == "none" else -self.waypoint_depth)

    @property
    def share_of_lifts(self) -> float:
        """Share of way-points above the surface."""
        usual = LIFT_SHARE_OF_BULLET if self.contact == "bullet" else 0.0
        return usual if self.lift_share is None else self.lift_share

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


_POSITIVE = (
    *("tool_mass", "tool_inertia", "clearance", "breakaway_velocity", "friction_smoothing", "joint_breakaway_velocity"),
    *("joint_presliding", "joint_smoothing", "torque_limits", "controller_omega", "least_acceleration"),
)
_NOT_NEGATIVE = (
    *("noise", "joint_damping", "viscous_coefficient", "coulomb_coefficient", "static_coefficient", "patch_factor"),
    *("press", "lift_height", "joint_coulomb", "joint_static", "joint_viscous", "baumgarte_omega", "baumgarte_zeta"),
    *("joint_asymmetry", "joint_load", "controller_zeta", "null_space_stiffness", "null_space_damping"),
    "waypoint_depth",
)
_FINITE = (
    *("gravity", "base_height", "tool_center_of_mass", "tool_point", "surface_height", "tilt_axis", "patch_x"),
    *("start_degrees", "waypoint_x", "waypoint_y"),
)
_RANGES: dict[str, Range] = {
    "seconds": ("from 0.1 to 1e5 s", 0.1, 1e5),
    "time_step": ("from 1e-5 to 0.01 s", 1e-5, 0.01),
    "settle_seconds": ("from 0.5 to 1000 s", 0.5, 1e3),
    "tilt_degrees": ("from -30 to 30", -30.0, 30.0),
    "sphere_radius": ("from 1 to 1e6 m", 1.0, 1e6),
    "lift_share": ("from 0 to 1", 0.0, 1.0),
    "joint_drift": ("> 0", 1e-12, 1e9),
    "segment_seconds": ("from 0.05 to 100 s", 0.05, 100.0),
    **dict.fromkeys(_POSITIVE, POSITIVE),
    **dict.fromkeys(_NOT_NEGATIVE, NOT_NEGATIVE),
    **dict.fromkeys(_FINITE, FINITE),
}
_LENGTHS = {item.name: len(item.default) for item in fields(KukaSurfaceConfig) if isinstance(item.default, tuple)}
_CHOICES = {"surface": Surface, "contact": ContactKind}


@dataclass(frozen=True, kw_only=True)
class CommonConfig:
    """What every scenario without a surface has; `noise` is that of the acceleration."""

    seconds: float = 60.0
    seed: int = 0
    noise: float = 0.1
    episodes: int = 1

    def _check(self, **ranges: Range) -> None:
        """Raise InvalidInput for these numbers, and those that have one of the ranges."""
        for name, allowed in {"seconds": POSITIVE, "noise": NOT_NEGATIVE, **ranges}.items():
            checked_numbers(name, getattr(self, name), allowed, None)
        require_integer("seed", self.seed, 0, 2**31)
        require_integer("episodes", self.episodes, 1, 10_000)


@dataclass(frozen=True, kw_only=True)
class FreeArmConfig(CommonConfig):
    """PD control with gravity compensation along sines of random size and rate, two per joint, about a posture.

    `joint_friction` names laws of `forcegp.forces`, or "none"; None is dry friction with more near rest. With viscous
    friction as well. Numbers that the name does not give are in proportion to the largest torque of a joint. `noise`
    in rad/s^2. Raises InvalidInput naming the field and its range.
    """

    arm: Literal["ur5-free", "double-pendulum"]
    joint_friction: str | None = None

    @usable_arguments("FreeArmConfig")
    def __post_init__(self) -> None:
        self._check()
        usual_dry_friction(self)
        require_known("arm", self.arm, "forcegp simulate", ("ur5-free", "double-pendulum"))


@dataclass(frozen=True, kw_only=True)
class QuadrupedConfig(CommonConfig):
    """A robot that stands, shifts its weight and lifts its feet; `payload` in kg on its trunk is in no robot file.

    With `lift` each foot in turn leaves the ground for a second. Friction as in `FreeArmConfig`, equal in all joints.
    `noise` in rad/s^2 and m/s^2. Raises InvalidInput naming the field and its range.
    """

    seconds: float = 30.0
    payload: float = 2.0
    lift: bool = True
    joint_friction: str | None = None

    @usable_arguments("QuadrupedConfig")
    def __post_init__(self) -> None:
        self._check(payload=NOT_NEGATIVE)
        usual_dry_friction(self)


@dataclass(frozen=True, kw_only=True)
class QuadrotorConfig(CommonConfig):
    """A drone that follows a path in `wind` [m/s] from a random side, with gusts; rotors follow within `lag` [s].

    `seed` draws path, side and gusts; the drone is always the same. `noise` in rad/s^2 and m/s^2. Raises InvalidInput
    naming the field and its range.
    """

    wind: float = 4.0
    lag: float = 0.06

    @usable_arguments("QuadrotorConfig")
    def __post_init__(self) -> None:
        self._check(wind=("from 0 to 15 m/s", 0.0, 15.0), lag=("from 0.005 to 0.2 s", 0.005, 0.2))


@dataclass(frozen=True)
class Scenario:
    """A simulation that makes a Dataset. Its libraries are imported at `simulate`, so that listing scenarios is quick.

    summary: one line; config: frozen dataclass of all its numbers; function: "module:name" of a function
    `(config, progress=None) -> Dataset`.
    """

    summary: str
    config: type
    function: str

    def simulate(self, config: Any, progress: Callable[[int, int], None] | None = None) -> forcegp.data.Dataset:
        """Run it. `progress(steps done, steps in total)` is called now and then."""
        if not isinstance(config, self.config):
            raise InvalidInput(f"config is {type(config).__name__}; this scenario takes {self.config.__name__}.")
        module, _, name = self.function.partition(":")
        return getattr(import_module(module), name)(config, progress)


FREE_ARM = "forcegp.simulation.free_arms:simulate_free_arm"
SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        "kuka-surface": Scenario(
            summary="a KUKA iiwa slides its tool on a surface with friction that nobody models",
            config=KukaSurfaceConfig,
            function="forcegp.simulation.kuka_surface:simulate_kuka_surface",
        ),
        "ur5-free": Scenario("a UR5 that touches nothing, with friction in every joint", FreeArmConfig, FREE_ARM),
        "quadruped": Scenario(
            "a quadruped that stands and shifts its weight, with a load and friction in every joint",
            QuadrupedConfig,
            "forcegp.simulation.quadruped:simulate_quadruped",
        ),
        "quadrotor": Scenario(
            "a drone that follows a path in wind, with late rotors and air forces that nobody models",
            QuadrotorConfig,
            "forcegp.simulation.quadrotor:simulate_quadrotor",
        ),
        "double-pendulum": Scenario("two driven rods with friction in both hinges", FreeArmConfig, FREE_ARM),
    }
)
