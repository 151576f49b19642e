"""Unknown forces at one point of the robot: `ToolForces`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, require_type, usable_arguments
from forcegp.forces.joint_forces import chosen_inputs, driven, state_labels
from forcegp.forces.kernels import check_kernel
from forcegp.forces.unknown import ExpressedKernels, Scaling
from forcegp.mechanics import ConstrainedDynamics, Contact, LoopClosure, surface_axes
from forcegp.mechanics.gauss_principle import placed
from forcegp.robots import Robot

AXES = ("world", "tool", "surface")


@dataclass(frozen=True, eq=False)
class ToolPoint:
    """A point fixed in a link: world position [m], Jacobian (linear; angular) and orientation of the link's axes."""

    position: Float[Tensor, "*batch 3"]
    jacobian: Float[Tensor, "*batch 6 nv"]
    orientation: Float[Tensor, "*batch 3 3"]

    @classmethod
    def of(cls, dynamics: ConstrainedDynamics, frame: str, point: Sequence[float]) -> "ToolPoint":
        """At every state of the dynamics. Raises UnknownFrame."""
        kinematics = dynamics.state.kinematics
        axes, position = placed(kinematics, frame, point)
        return cls(position, kinematics.frame_jacobian(frame, tuple(point)), axes)

    @classmethod
    def of_contact(cls, dynamics: ConstrainedDynamics, contact: int) -> "ToolPoint":
        """The point that touches."""
        touching = dynamics.contacts[contact]
        return cls.of(dynamics, touching.frame, touching.point)

    def velocity(self, v: Float[Tensor, "*batch nv"]) -> Float[Tensor, "*batch 6"]:
        """Linear [m/s] and angular velocity [rad/s] in world axes."""
        return (self.jacobian @ v[..., None])[..., 0]


def contact_axes(dynamics: ConstrainedDynamics, contact: int) -> Float[Tensor, "*batch 3 3"]:
    """Tangents t1, t2 and normal n of a contact's surface, as columns in world axes."""
    return surface_axes(dynamics.normals[..., contact, :])


def nominal_normal_force(dynamics: ConstrainedDynamics, contact: int) -> Float[Tensor, "*batch"]:
    """|normal force| in N that the contact would have if the known forces were all: |s_p| |lambda(Q_U = 0)|."""
    size = torch.linalg.vector_norm(dynamics.normals[..., contact, :], dim=-1)
    return size * dynamics.multiplier_map().offset[..., contact].abs()


def finite_numbers(given: object) -> tuple[float, ...] | None:
    """`given` as finite floats, None where it is anything else."""
    try:
        numbers = tuple(float(entry) for entry in given)  # type: ignore[attr-defined]  # that is what is tried
    except (TypeError, ValueError):
        return None
    return numbers if not isinstance(given, str) and all(map(math.isfinite, numbers)) else None


def is_contact_number(value: object) -> bool:
    """Whether it can be the number of a contact, counted from 0."""
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def require_contact(force: str, contact: int, contacts: Sequence[Contact]) -> None:
    """Raise InvalidInput if there is no such contact to slide on."""
    sliding = (not isinstance(each, LoopClosure) for each in contacts)
    numbers = [index for index, slides in enumerate(sliding) if slides]
    if contact not in numbers:
        have = f"only contact {', '.join(map(str, numbers))}" if numbers else "no contact with a surface to slide on"
        raise InvalidInput(
            f"{force} acts at contact {contact}, but the model has {have}; give the contact (`contacts`), or use a "
            "force that needs none, such as JointFriction or ToolForces(frame=..., axes='world')."
        )


def require_moving(prior: str, frame: str, robot: Robot) -> None:
    """Raise UnknownFrame for a frame that does not exist, InvalidInput for one that is fixed in the world."""
    body, _ = robot.frame(frame)
    if body < 0:
        moving = [name for name in robot.link_names if robot.frame(name)[0] >= 0]
        raise InvalidInput(
            f"{prior} acts on frame {frame!r}, which is fixed in the world and never moves, so its forces move "
            f"nothing; give a frame of a moving link: {', '.join(moving)}."
        )


TOOL_INPUTS = ("velocity", "angular-velocity", "position", "load", "q", "v", "u")
SMALLEST_SPEED = 1e-6
"""m/s, below which a direction of motion means nothing: far below any velocity scale of friction."""
NAMES = {"world": ("x", "y", "z"), "tool": ("tool-x", "tool-y", "tool-z"), "surface": ("tangent-1", "tangent-2")}
TORQUE_NAMES = {**NAMES, "surface": ("tangent-1", "tangent-2", "normal")}


@dataclass(frozen=True)
class ToolForces(ExpressedKernels):
    """Q_U = J_p^T E f(z): a force (N) with components f along the axes E at a point, and a torque (Nm) with `torque`.

    Parameters
    ----------
    frame, point: the link and the point in it (m) at which the force acts. Without a frame it acts where contact
        number `contact` touches, whatever the contact is later (another tool, another surface).
    axes: "world", "tool" (those of the link) or "surface": the two tangents of the contact's surface. Along its normal
        an ideal contact takes every force, so accelerations show none of it and there is no such latent.
    inputs: what the force depends on: "velocity", "angular-velocity" and "position" of the point along the same axes
        (the position along "tool" axes: along those of the world), "load" (the nominal normal force in N), "q", "v",
        "u".
    kernel: an expression of `forcegp.forces.kernel_of`.

    Velocities are only scaled, never shifted, so that a linear kernel is viscous friction. Forces along "surface" axes
    vanish where the constraint does not have the contact.
    """

    frame: str | None = None
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axes: str = "surface"
    inputs: tuple[str, ...] = ("velocity",)
    torque: bool = False
    contact: int = 0
    kernel: str = "linear + squared-exponential"

    @usable_arguments("ToolForces")
    def __post_init__(self) -> None:
        require_type("ToolForces torque", self.torque, bool)
        object.__setattr__(self, "inputs", chosen_inputs("ToolForces", self.inputs, TOOL_INPUTS))
        check_kernel(self.kernel)
        if not (self.frame is None or isinstance(self.frame, str)):
            raise InvalidInput(f"ToolForces frame is {self.frame!r}; give the name of a link, or None for the contact.")
        point = finite_numbers(self.point)
        if self.axes not in AXES or point is None or len(point) != 3 or not is_contact_number(self.contact):
            raise InvalidInput(
                f"ToolForces has axes {self.axes!r}, point {self.point!r} and contact {self.contact!r}; give axes "
                f"{' or '.join(map(repr, AXES))}, a point of three numbers in m, and a contact's number from 0."
            )
        object.__setattr__(self, "point", point)

    @property
    @override
    def title(self) -> str:
        return "tool-friction" if set(self.inputs) <= {"velocity", "angular-velocity"} else "tool-forces"

    @property
    def _needs_contact(self) -> bool:
        return self.frame is None or self.axes == "surface" or "load" in self.inputs

    @override
    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        if self._needs_contact:
            require_contact(f"ToolForces(frame={self.frame!r}, axes={self.axes!r})", self.contact, contacts)
        if self.frame is not None:
            require_moving("ToolForces", self.frame, robot)

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        torques = TORQUE_NAMES[self.axes] if self.torque else ()
        return (*(f"force-{name}" for name in NAMES[self.axes]), *(f"torque-{name}" for name in torques))

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        where = self._point(dynamics)
        if where is None:
            return torch.zeros_like(dynamics.H[..., :1]).expand(*dynamics.H.shape[:-1], self._count)
        axes = self._directions(dynamics, where)
        forces = where.jacobian[..., :3, :].mT @ axes[..., : len(NAMES[self.axes])]
        if not self.torque:
            return forces
        return torch.cat([forces, where.jacobian[..., 3:, :].mT @ axes], dim=-1)

    @override
    def point_force(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch 3 C"]:
        where = self._point(dynamics)
        if where is None:
            return dynamics.H.new_zeros(*dynamics.H.shape[:-2], 3, self._count)
        forces = self._directions(dynamics, where)[..., : len(NAMES[self.axes])]
        torques = torch.zeros_like(forces[..., :1]).expand(*forces.shape[:-1], self._count - forces.shape[-1])
        return torch.cat([forces, torques], dim=-1)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        state, where = dynamics.state, self._point(dynamics)
        if where is None:  # the force is zero whatever its features are
            names = self.feature_names(state.robot)
            return (state.q.new_zeros(*state.q.shape[:-1], len(names[0])),) * self._count
        velocity, axes = where.velocity(state.v), self._directions(dynamics, where)
        tangents = axes[..., : len(NAMES[self.axes])]
        # along the normal of a surface the point neither moves nor changes its place
        columns = {
            "velocity": lambda: _along(tangents, velocity[..., :3]),
            "angular-velocity": lambda: _along(axes, velocity[..., 3:]),
            "position": lambda: _along(tangents, where.position) if self.axes == "surface" else where.position,
            "load": lambda: nominal_normal_force(dynamics, self.contact)[..., None],
            "q": lambda: state.robot.posture(state.q),
            "v": lambda: state.v,
            "u": lambda: driven(state),
        }
        z = torch.cat([columns[name]() for name in self.inputs], dim=-1)
        return (z,) * self._count

    @override
    def scalings(self, robot: Robot) -> tuple[tuple[Scaling, ...], ...]:
        origin = ("velocity", "angular-velocity", "v")
        labels = self._labels(robot)
        ways: tuple[Scaling, ...] = tuple(
            "scale" if name in origin else "standardize" for name in self.inputs for _ in labels[name]
        )
        return (ways,) * self._count

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        labels = self._labels(robot)
        return (tuple(label for name in self.inputs for label in labels[name]),) * self._count

    def _labels(self, robot: Robot) -> dict[str, Sequence[str]]:
        """Of the features that every input brings."""
        along, turning = NAMES[self.axes], TORQUE_NAMES[self.axes]
        return {
            "velocity": [f"tool velocity along {axis} [m/s]" for axis in along],
            "angular-velocity": [f"tool angular velocity about {axis} [rad/s]" for axis in turning],
            "position": [f"tool position along {axis} [m]" for axis in (along if self.axes == "surface" else "xyz")],
            "load": ["nominal normal force [N]"],
            **state_labels(robot),
        }

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return tuple("N" if name.startswith("force") else "Nm" for name in self.latent_names(robot))

    @property
    def _count(self) -> int:
        return len(NAMES[self.axes]) + (3 if self.torque else 0)

    def _point(self, dynamics: ConstrainedDynamics) -> ToolPoint | None:
        """None where the force belongs to a contact that the constraint does not have."""
        if self._needs_contact and self.contact >= len(dynamics.contacts):
            return None
        if self.frame is None:
            return ToolPoint.of_contact(dynamics, self.contact)
        return ToolPoint.of(dynamics, self.frame, self.point)

    def _directions(self, dynamics: ConstrainedDynamics, where: ToolPoint) -> Float[Tensor, "*batch 3 3"]:
        if self.axes == "surface":
            axes = contact_axes(dynamics, self.contact)
            return _containing(axes, where.velocity(dynamics.state.v)[..., :3])
        if self.axes == "tool":
            return where.orientation
        identity = torch.eye(3, dtype=where.position.dtype, device=where.position.device)
        return identity.expand_as(where.orientation)


def _containing(axes: Float[Tensor, "*batch 3 3"], velocity: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The axes with tangents t + n (t v_t) v_n / |v|^2, whose plane contains the velocity to first order in v_n / |v|.

    A simulated or measured point drifts off its surface a little, and what resists its motion resists that part, too.
    The accelerations show nothing of it, but the normal force does (5e-4 of 7.7 N on `kuka-surface`).
    """
    tangents, normal = axes[..., :2], axes[..., 2:]
    along, off = _along(tangents, velocity), _along(normal, velocity)
    tilt = along * off / velocity.square().sum(-1, keepdim=True).clamp_min(SMALLEST_SPEED**2)
    return torch.cat([tangents + normal * tilt[..., None, :], normal], dim=-1)


def _along(axes: Float[Tensor, "*batch 3 k"], vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch k"]:
    return (axes.mT @ vector[..., None])[..., 0]
