"""Priors at the joints: on all of (q, v, u), of forces or accelerations, and one function per joint."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, UnknownName, require_known, usable_arguments
from forcegp.forces.force import joint_unit, slides
from forcegp.forces.kernels import checked_kernel
from forcegp.forces.unknown import ExpressedKernels, Scaling, SharedInputs, as_names
from forcegp.mechanics import ConstrainedDynamics, Contact
from forcegp.robots import Robot

QUANTITIES = {"q": "position", "v": "velocity", "a": "acceleration", "u": "force"}


def joint_units(quantity: str, joints: Sequence[str], robot: Robot) -> tuple[str, ...]:
    """The unit that a key of `QUANTITIES` has at each of the joints, which turn or slide."""
    return tuple(joint_unit(QUANTITIES[quantity], slides(name, robot)) for name in joints)


def joint_labels(what: str, quantity: str, joints: Sequence[str], robot: Robot) -> tuple[str, ...]:
    """`what` of every joint with its unit, for example "velocity of joint_1 [rad/s]"."""
    units = joint_units(quantity, joints, robot)
    return tuple(f"{what} of {name} [{unit}]" for name, unit in zip(joints, units, strict=True))


@dataclass(frozen=True)
class JointForces(SharedInputs):
    """Q_U = f(x) with independent f_j ~ GP(0, k_j), one per joint (Rath et al. 2021, eqs. 5-7).

    `inputs` chooses which of q, v and u it depends on; `kernel` is an expression of `forcegp.forces.kernel_of`.
    """

    inputs: tuple[str, ...] = ("q", "v", "u")
    kernel: str = "squared-exponential"
    allowed: ClassVar[tuple[str, ...]] = ("q", "v", "u")

    @usable_arguments("JointForces")
    def __post_init__(self) -> None:
        super().__post_init__()

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return robot.joint_names

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        H = dynamics.H
        return torch.eye(H.shape[-1], dtype=H.dtype, device=H.device).expand_as(H)

    @override
    def columns(self, dynamics: ConstrainedDynamics) -> dict[str, Callable[[], Tensor]]:
        state = dynamics.state
        # of actuators at all joints of one degree of freedom; at the base of a robot that has none
        driven = joint_indices(None, state.robot) if state.robot.layout.groups else []
        return {
            "q": lambda: state.robot.posture(state.q),
            "v": lambda: state.v,
            "u": lambda: state.delivered[..., driven] if driven else state.delivered,
        }

    @override
    def labels(self, robot: Robot) -> dict[str, tuple[str, ...]]:
        joints, singles = robot.joint_names, robot.single_joint_names
        positions = joint_labels("q", "q", singles, robot)
        bases = robot.posture_names[: len(robot.posture_names) - len(singles)]
        forces = joint_labels("u", "u", singles or joints, robot)
        return {"q": (*bases, *positions), "v": joint_labels("v", "v", joints, robot), "u": forces}

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return joint_units("u", robot.joint_names, robot)


@dataclass(frozen=True)
class JointAccelerations(JointForces):
    """Q_U = M f(x): the processes f_j are the acceleration (rad/s^2, m/s^2) that an unconstrained robot would have.

    H M f is the projection of f onto what the constraint allows (Geist & Trimpe 2020, the S-GP [38] of Rath et al.
    2021). In a model without `RigidBodies` processes carry gravity and actuation, too.
    """

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return dynamics.M

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return joint_units("a", robot.joint_names, robot)


@dataclass(frozen=True)
class IndependentAccelerations(JointAccelerations):
    """Those of a model without contacts and laws, `model.black_box()`: the baseline "GP" of Rath et al. (2021).

    Nothing is shared between joints, so that a search costs nv N^3 and not (nv N)^3.
    """

    @override
    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        if contacts:
            raise InvalidInput("IndependentAccelerations know of no contact; model.black_box() is the model of them.")


class PerJoint(ExpressedKernels):
    """Q_U,j = f_j(x_j), or minus that, in Nm or N: an independent function per joint, of its own position or velocity.

    A subclass is a dataclass with the field `joints` (names, None: all), and defines by `depends_on` what x_j is.
    """

    joints: tuple[str, ...] | None
    depends_on: ClassVar[Literal["q", "v"]]

    def __post_init__(self) -> None:
        names, prior = as_names(self.joints), type(self).__name__
        if self.joints is not None:
            if not names or any(not isinstance(name, str) for name in names) or len(set(names)) < len(names):
                raise InvalidInput(f"{prior} joints are {self.joints!r}; give names, each once, or None for all.")
            object.__setattr__(self, "joints", names)
        checked_kernel(self.kernel)

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return robot.single_joint_names if self.joints is None else self.joints

    @override
    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        if not joint_indices(self.joints, robot):
            seen = f"{type(self).__name__} acts in joints, and {robot.name} has none but its base"
            raise InvalidInput(f"{seen}; leave it out, or use aerodynamic.")

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
        singles, position = state.robot.single_joint_names, state.robot.space.singles(state.q)
        return tuple(position[..., singles.index(name), None] for name in self.latent_names(state.robot))

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        what = QUANTITIES[self.depends_on]
        return tuple((label,) for label in joint_labels(what, self.depends_on, self.latent_names(robot), robot))

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return joint_units("u", self.latent_names(robot), robot)


def joint_indices(joints: Sequence[str] | None, robot: Robot) -> list[int]:
    """Places in v of the joints, None: all of one degree of freedom. Raises UnknownName for a name of none."""
    names = robot.joint_names
    for joint in joints or ():
        require_known("joint", joint, robot.name, names, UnknownName)
    return [names.index(joint) for joint in (robot.single_joint_names if joints is None else joints)]


@dataclass(frozen=True)
class JointFriction(PerJoint):
    """Q_U,j = -f_j(v_j): what resists joint j, positive for positive velocity, an independent function per joint.

    The kernel "friction" gives f_j(v) = tanh(v / w) g(v) + d v: dry friction that varies with velocity and direction,
    and viscous friction. Velocities are only scaled, so that zero stays zero. `joints` restricts it to some, by name.
    """

    joints: tuple[str, ...] | None = None
    kernel: str = "friction"
    depends_on: ClassVar[Literal["q", "v"]] = "v"

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return -super().direction(dynamics)

    @override
    def scalings(self, robot: Robot) -> tuple[Scaling, ...]:
        return ("scale",) * len(self.latent_names(robot))


@dataclass(frozen=True)
class JointPositionForces(PerJoint):
    """Q_U,j = f_j(q_j): what pushes joint j where it is, such as springs and cables; `joints`: of some joints only."""

    joints: tuple[str, ...] | None = None
    kernel: str = "squared-exponential"
    depends_on: ClassVar[Literal["q", "v"]] = "q"
