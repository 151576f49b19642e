"""Priors at the joints: on all of (q, v, u), of forces or accelerations, one function per joint, and no force."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

import torch
from gpytorch.constraints import Positive
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, UnknownJoint, require_known, usable_arguments
from forcegp.forces.basic_kernels import periodic
from forcegp.forces.kernels import check_kernel
from forcegp.forces.unknown import ExpressedKernels, Scaling, Unknown
from forcegp.mechanics import ConstrainedDynamics, Contact, State
from forcegp.robots import Robot
from forcegp.robots.arguments import is_sequence

UNITS = {"q": ("rad", "m"), "v": ("rad/s", "m/s"), "a": ("rad/s^2", "m/s^2"), "u": ("Nm", "N")}
"""Of positions, velocities, accelerations and forces, for joints that turn and joints that slide."""


def joint_units(quantity: str, joints: Sequence[str], robot: Robot) -> tuple[str, ...]:
    """The unit that a key of `UNITS` has at each of the joints."""
    turning, sliding = UNITS[quantity]
    slides = {joint.name for joint in robot.joints if joint.type == "prismatic"}
    return tuple(sliding if name in slides else turning for name in joints)


def joint_labels(what: str, quantity: str, joints: Sequence[str], robot: Robot) -> tuple[str, ...]:
    """`what` of every joint with its unit, for example "velocity of joint_1 [rad/s]"."""
    units = joint_units(quantity, joints, robot)
    return tuple(f"{what} of {name} [{unit}]" for name, unit in zip(joints, units, strict=True))


INPUTS = ("q", "v", "u")
ANGLES = ("plain", "sin-cos")


@dataclass(frozen=True)
class JointForces(ExpressedKernels):
    """Q_U = f(x) with independent f_j ~ GP(0, k_j), one per joint (Rath et al. 2021, eqs. 5-7).

    `inputs` chooses which of q, v and u the force may depend on. With `angles="sin-cos"` the position of every joint
    that turns enters as its sine and cosine, so that a full turn changes nothing and +pi is beside -pi. `kernel` is an
    expression of `forcegp.forces.kernel_of`; the default has one length scale per feature.
    """

    inputs: tuple[str, ...] = INPUTS
    kernel: str = "squared-exponential"
    angles: str = "plain"

    @usable_arguments("JointForces")
    def __post_init__(self) -> None:
        object.__setattr__(self, "inputs", chosen_inputs(type(self).__name__, self.inputs, INPUTS))
        check_kernel(self.kernel)
        if self.angles not in ANGLES:
            raise InvalidInput(f"{type(self).__name__} angles is {self.angles!r}; give 'plain' or 'sin-cos'.")

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return robot.joint_names

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        H = dynamics.H
        return torch.eye(H.shape[-1], dtype=H.dtype, device=H.device).expand_as(H)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        state = dynamics.state
        posture = state.robot.posture(state.q)
        columns = {"q": posture, "v": state.v, "u": driven(state)}
        if self.angles == "sin-cos":
            turns = _turns(state.robot)
            waves = posture[..., turns].sin(), posture[..., turns].cos()
            columns["q"] = torch.cat([posture[..., ~turns], *waves], dim=-1)
        z = torch.cat([columns[name] for name in self.inputs], dim=-1)
        return (z,) * state.v.shape[-1]

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        named = state_labels(robot)
        if self.angles == "sin-cos":
            turns = _turns(robot).tolist()
            turning = [name for name, turn in zip(robot.posture_names, turns, strict=True) if turn]
            sliding = [label for label, turn in zip(named["q"], turns, strict=True) if not turn]
            waves = [f"{wave} q of {joint}" for wave in ("sin", "cos") for joint in turning]
            named["q"] = (*sliding, *waves)
        return (tuple(entry for name in self.inputs for entry in named[name]),) * robot.nv

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return joint_units("u", robot.joint_names, robot)


def chosen_inputs(prior: str, given: object, allowed: tuple[str, ...]) -> tuple[str, ...]:
    """`given` as a tuple of names from `allowed`, each once. Raises InvalidInput for anything else."""
    inputs = as_names(given)
    if not inputs or any(name not in allowed for name in inputs) or len(set(inputs)) < len(inputs):
        names = ", ".join(map(repr, allowed))
        raise InvalidInput(f"{prior} inputs are {given!r}; give one or more of {names}, each once.")
    return inputs


def as_names(given: object) -> tuple[Any, ...]:
    """One name, or several, as a tuple; empty for what is neither."""
    if isinstance(given, str):
        return (given,)
    return tuple(given) if is_sequence(given) else ()


def state_labels(robot: Robot) -> dict[str, tuple[str, ...]]:
    """Names with units of the features that q, v and u give: the posture, all velocities, `driven` forces."""
    joints, singles = robot.joint_names, robot.single_joint_names
    positions = joint_labels("q", "q", singles, robot)
    bases = robot.posture_names[: len(robot.posture_names) - len(singles)]
    forces = joint_labels("u", "u", singles or joints, robot)
    return {"q": (*bases, *positions), "v": joint_labels("v", "v", joints, robot), "u": forces}


def driven(state: State) -> Float[Tensor, "*batch joints"]:
    """Forces of the actuators at all joints of one degree of freedom; at the base of a robot that has none."""
    rows = joint_indices(None, state.robot)
    return state.delivered[..., rows] if rows and state.robot.layout.groups else state.delivered


def _turns(robot: Robot) -> Tensor:
    """Which entries of the posture are angles."""
    angles = {joint.name for joint in robot.joints if joint.type != "prismatic"} & {*robot.single_joint_names}
    return torch.tensor([name in angles for name in robot.posture_names], device=robot.device)


@dataclass(frozen=True)
class JointAccelerations(JointForces):
    """Q_U = M f(x): the processes f_j are the acceleration (rad/s^2, m/s^2) that an unconstrained robot would have.

    Then H M f = f - M^-1 A^T (A M^-1 A^T)^+ A f, the projection of f onto what the constraint allows (Geist & Trimpe
    2020, "Learning constrained dynamics with Gauss' principle adhering Gaussian processes", the S-GP [38] of Rath et
    al. 2021). In a model without `RigidBodies` processes carry gravity and actuation, too. Without contacts H M is the
    identity, and this is an independent Gaussian process per joint.
    """

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return dynamics.M

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return joint_units("a", robot.joint_names, robot)


@dataclass(frozen=True)
class IndependentAccelerations(JointAccelerations):
    """Those of a model without contacts and laws: one Gaussian process per joint, without physics.

    The baseline "GP" of Rath et al. (2021), the row "independent GP" of every comparison. Nothing is shared between
    joints, so that a search costs nv N^3 and not (nv N)^3. It is a model's only force: `model.black_box()`.
    """

    @override
    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        if contacts:
            raise InvalidInput("IndependentAccelerations know of no contact; model.black_box() is the model of them.")


class PerJoint(Unknown):
    """Q_U,j = f_j(x_j), or minus that, in Nm or N: an independent function per joint, of its own position or velocity.

    A subclass is a dataclass with the field `joints` (names as `chosen_joints` gives them, None: all), and defines by
    `depends_on` what x_j is: "q" or "v".
    """

    joints: Any  # names of joints, or None, of which every subclass names its own default
    depends_on: ClassVar[Literal["q", "v"]]

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return robot.single_joint_names if self.joints is None else self.joints

    @override
    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        if not joint_indices(self.joints, robot):
            raise InvalidInput(
                f"{type(self).__name__} acts in joints, and {robot.name} has none but its base; leave it out, "
                "or use base-wrench or aerodynamic."
            )

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        H = dynamics.H
        columns = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
        columns = columns[:, joint_indices(self.joints, dynamics.state.robot)]
        return columns.expand(*H.shape[:-2], *columns.shape)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        state = dynamics.state
        if self.depends_on == "v":
            return tuple(state.v[..., index, None] for index in joint_indices(self.joints, state.robot))
        singles = state.robot.single_joint_names
        position = state.robot.space.singles(state.q)
        return tuple(position[..., singles.index(name), None] for name in self.latent_names(state.robot))

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        what = {"q": "position", "v": "velocity"}[self.depends_on]
        return tuple((label,) for label in joint_labels(what, self.depends_on, self.latent_names(robot), robot))

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return joint_units("u", self.latent_names(robot), robot)


def chosen_joints(prior: str, given: object) -> tuple[str, ...] | None:
    """Names of joints as a tuple; None stands for all. Raises InvalidInput for what is no list of different names."""
    if given is None:
        return None
    names = as_names(given)
    if not names or any(not isinstance(name, str) for name in names) or len(set(names)) < len(names):
        raise InvalidInput(f"{prior} joints are {given!r}; give names of joints, each once, or None for all.")
    return names


def joint_indices(joints: Sequence[str] | None, robot: Robot) -> list[int]:
    """Places in v of the joints, None: all of one degree of freedom. Raises UnknownJoint for a name of none."""
    names = robot.joint_names
    for joint in joints or ():
        require_known("joint", joint, robot.name, names, UnknownJoint)
    return [names.index(joint) for joint in (robot.single_joint_names if joints is None else joints)]


@dataclass(frozen=True)
class JointFriction(PerJoint, ExpressedKernels):
    """Q_U,j = -f_j(v_j): what resists joint j, positive for positive velocity, an independent function per joint.

    The kernel "friction" gives f_j(v) = tanh(v / w) g(v) + d v with a learned velocity scale w and an unknown level g
    (`basic_kernels.py`): dry friction that varies with velocity, and viscous friction, zero at rest, different in the
    two directions if the data show it (Armstrong-Helouvry, Dupont & Canudas de Wit 1994 list these). Velocities are
    only scaled, never shifted, so that zero stays zero. `joints` restricts the prior to some joints, by name.
    """

    depends_on: ClassVar[Literal["q", "v"]] = "v"

    joints: tuple[str, ...] | None = None
    kernel: str = "friction"

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", chosen_joints(type(self).__name__, self.joints))
        check_kernel(self.kernel)

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return -super().direction(dynamics)

    @override
    def scalings(self, robot: Robot) -> tuple[Scaling, ...]:
        return ("scale",) * len(self.latent_names(robot))


@dataclass(frozen=True)
class JointPositionForces(PerJoint, ExpressedKernels):
    """Q_U,j = f_j(q_j): what pushes joint j where it is, an independent function per joint.

    Springs of motors and cables that harden, counterweights, hoses. `joints` restricts the prior to some joints, by
    name; `kernel` is an expression of `forcegp.forces.kernel_of`.
    """

    depends_on: ClassVar[Literal["q", "v"]] = "q"

    joints: tuple[str, ...] | None = None
    kernel: str = "squared-exponential"

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", chosen_joints(type(self).__name__, self.joints))
        check_kernel(self.kernel)


PERIOD_SPREAD = 0.02
"""Standard deviation of the prior on the logarithm of a period: likelihoods of periods have many narrow optima."""


@dataclass(frozen=True)
class PeriodicJointForces(PerJoint):
    """Q_U,j = f_j(q_j) with f_j of period `period` (rad, or m for joints that slide), one independent function each.

    The kernel is s exp(-2 sin^2(pi (q - q') / period) / l) (MacKay 1998; Rasmussen & Williams 2006, eq. 4.31, with l
    the square of their length scale). The period is fitted too, near the value given: a motor with 12 pole pairs has
    2 pi / 12, behind a gear of ratio 100 it is 2 pi / 1200. `joints` restricts the prior to some joints, by name.
    """

    depends_on: ClassVar[Literal["q", "v"]] = "q"

    period: float = 2.0 * math.pi
    joints: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", chosen_joints(type(self).__name__, self.joints))
        if not isinstance(self.period, int | float) or not 0.0 < self.period < math.inf:
            raise InvalidInput(f"PeriodicJointForces period is {self.period!r}; give a positive number in rad (or m).")
        object.__setattr__(self, "period", float(self.period))

    @override
    def scalings(self, robot: Robot) -> tuple[Scaling, ...]:
        return ("none",) * len(self.latent_names(robot))  # the period is in rad

    @override
    def kernels(self, robot: Robot, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        near = Positive(partial(_period, self.period), partial(_spreads, self.period))  # type: ignore[arg-type]  # stubs
        how: dict[str, Any] = {"period": self.period, "spread": PERIOD_SPREAD, "constraint": near}
        return tuple(periodic(1, variance, **how) for variance in variances)


def _period(given: float, spreads: Tensor) -> Tensor:
    """A period that is searched in standard deviations of its prior, so that restarts begin near the one given, too."""
    return given * (PERIOD_SPREAD * spreads).exp()


def _spreads(given: float, period: Tensor) -> Tensor:
    return (period / given).log() / PERIOD_SPREAD
