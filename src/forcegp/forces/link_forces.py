"""Unknown forces on one link: where it touches a surface (`ToolForces`), and those of air."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, require_number, usable_arguments
from forcegp.forces.actuation import ObservedWind
from forcegp.forces.unknown import SharedInputs
from forcegp.mechanics import ConstrainedDynamics, Contact, surface_axes
from forcegp.mechanics.gauss_principle import placed
from forcegp.robots import Robot
from forcegp.robots.arguments import finite_vector
from forcegp.robots.manifold import VELOCITIES


@dataclass(frozen=True, eq=False)
class ToolPoint:
    """A point fixed in a link: world position [m], Jacobian (linear; angular) and orientation of the link's axes."""

    position: Float[Tensor, "*batch 3"]
    jacobian: Float[Tensor, "*batch 6 nv"]
    orientation: Float[Tensor, "*batch 3 3"]

    @classmethod
    def of(cls, dynamics: ConstrainedDynamics, frame: str, point: Sequence[float]) -> "ToolPoint":
        """At every state of the dynamics. Raises UnknownName."""
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


def require_contact_number(force: str, contact: object) -> None:
    """Raise InvalidInput for what cannot be the number of a contact, counted from 0."""
    if isinstance(contact, bool) or not isinstance(contact, int) or contact < 0:
        raise InvalidInput(f"{force} has contact {contact!r}; give a contact's number from 0.")


def require_contact(force: str, contact: int, contacts: Sequence[Contact]) -> None:
    """Raise InvalidInput if there is no such contact to slide on."""
    numbers = range(len(contacts))
    if contact not in numbers:
        have = f"only contact {', '.join(map(str, numbers))}" if numbers else "no contact with a surface to slide on"
        seen = f"{force} acts at contact {contact}, but the model has {have}"
        other = "a force that needs none, such as JointFriction or AerodynamicForce(frame=...)"
        raise InvalidInput(f"{seen}; give the contact (`contacts`), or use {other}.")


TANGENTS = ("tangent-1", "tangent-2")
SMALLEST_SPEED = 1e-6  # m/s, below which a direction of motion means nothing: far below any velocity scale of friction


@dataclass(frozen=True)
class ToolForces(SharedInputs):
    """Q_U = J_p^T E f(z): a force (N) where contact number `contact` touches, along the tangents E of its surface.

    Along its normal an ideal contact takes every force, so there is no such latent; without it the force is zero.

    inputs: "velocity" and "position" of the point along the tangents. Velocities are only scaled, so that a linear
        kernel is viscous friction.
    kernel: an expression of `forcegp.forces.kernel_of`.
    """

    contact: int = 0
    inputs: tuple[str, ...] = ("velocity",)
    kernel: str = "linear + squared-exponential"
    allowed: ClassVar[tuple[str, ...]] = ("velocity", "position")
    from_zero: ClassVar[tuple[str, ...]] = ("velocity",)

    @usable_arguments("ToolForces")
    def __post_init__(self) -> None:
        super().__post_init__()
        require_contact_number("ToolForces", self.contact)

    @property
    @override
    def title(self) -> str:
        return "tool-forces" if "position" in self.inputs else "tool-friction"

    @override
    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        require_contact("ToolForces", self.contact, contacts)

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return tuple(f"force-{name}" for name in TANGENTS)

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        if self.contact >= len(dynamics.contacts):
            return torch.zeros_like(dynamics.H[..., :2])
        where = ToolPoint.of_contact(dynamics, self.contact)
        return where.jacobian[..., :3, :].mT @ self._directions(dynamics, where)

    @override
    def point_force(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch 3 C"]:
        if self.contact >= len(dynamics.contacts):
            return dynamics.H.new_zeros(*dynamics.H.shape[:-2], 3, 2)
        return self._directions(dynamics, ToolPoint.of_contact(dynamics, self.contact))

    @override
    def columns(self, dynamics: ConstrainedDynamics) -> dict[str, Callable[[], Tensor]]:
        state = dynamics.state
        if self.contact >= len(dynamics.contacts):  # the force is zero whatever its features are
            return dict.fromkeys(self.allowed, lambda: state.q.new_zeros(*state.q.shape[:-1], 2))
        where = ToolPoint.of_contact(dynamics, self.contact)
        axes = self._directions(dynamics, where)
        return {
            "velocity": lambda: _along(axes, where.velocity(state.v)[..., :3]),
            "position": lambda: _along(axes, where.position),
        }

    @override
    def labels(self, robot: Robot) -> dict[str, Sequence[str]]:
        units = {"velocity": "m/s", "position": "m"}
        return {what: [f"tool {what} along {x} [{unit}]" for x in TANGENTS] for what, unit in units.items()}

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return ("N", "N")

    def _directions(self, dynamics: ConstrainedDynamics, where: ToolPoint) -> Float[Tensor, "*batch 3 2"]:
        """Tangents t + n (t v_t) v_n / |v|^2, since what resists a point resists its drift off the surface, too."""
        axes, velocity = contact_axes(dynamics, self.contact), where.velocity(dynamics.state.v)[..., :3]
        tangents, normal = axes[..., :2], axes[..., 2:]
        along, off = _along(tangents, velocity), _along(normal, velocity)
        tilt = along * off / velocity.square().sum(-1, keepdim=True).clamp_min(SMALLEST_SPEED**2)
        return tangents + normal * tilt[..., None, :]


def _along(axes: Float[Tensor, "*batch 3 k"], vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch k"]:
    return (axes.mT @ vector[..., None])[..., 0]


AIR_INPUTS = ("velocity", "drag", "rotor-drag", "angular-velocity", "thrust", "height", "attitude")


@dataclass(frozen=True)
class AerodynamicForce(SharedInputs):
    """Q_U = J^T E f(z): a force [N] and a torque [Nm] on a link, along the link's own axes E and about its origin.

    By default what air does to a body that flies: drag, changes of thrust with the flow and near the ground, and wind.
    A linear kernel of the inputs holds the usual laws (Faessler, Franchi & Scaramuzza, IEEE RA-L 2018).

    frame: the link; None stands for the first that moves freely, the trunk or body of the robot.
    inputs: "velocity" (along the link's axes), "drag" (|velocity| velocity), "rotor-drag" (the root of the thrust times
        velocity), "angular-velocity", "thrust" (force of all actuators on the free base along z, and torques about all
        axes), "height" of the link, "attitude" (the world's axes in those of the link). Velocities are those against
        the air: the fit finds the wind of its rows.
    kernel: an expression of `forcegp.forces.kernel_of`.
    observe: the time in s that the observer of the force that stays unexplained looks back
        (`forcegp.posterior.observing`); None follows the recording, 0 observes nothing.
    wind: [m/s, world] where u has no columns of an `ObservedWind`.
    """

    frame: str | None = None
    inputs: tuple[str, ...] = AIR_INPUTS
    kernel: str = "linear"
    observe: float | None = None
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    allowed: ClassVar[tuple[str, ...]] = AIR_INPUTS
    from_zero: ClassVar[tuple[str, ...]] = AIR_INPUTS[:-2]

    @usable_arguments("AerodynamicForce")
    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.frame is None or isinstance(self.frame, str)):
            raise InvalidInput(f"AerodynamicForce frame is {self.frame!r}; give the name of a link, or None.")
        wind = finite_vector("AerodynamicForce wind", self.wind, 3, ", its velocity along x, y and z in m/s")
        object.__setattr__(self, "wind", tuple(wind.tolist()))
        if self.observe is not None:
            require_number("AerodynamicForce observe", self.observe, "give a time in s, 0, or None", 0.0, 1e6)

    @override
    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        frame = self.link(robot)
        if robot.frame(frame)[0] < 0:
            moving = ", ".join(name for name in robot.link_names if robot.frame(name)[0] >= 0)
            seen = f"AerodynamicForce acts on frame {frame!r}, which is fixed in the world and never moves"
            raise InvalidInput(f"{seen}, so its forces move nothing; give a frame of a moving link: {moving}.")

    def link(self, robot: Robot) -> str:
        """The link that the force acts on. Raises InvalidInput where none is named and none moves freely."""
        if self.frame is not None:
            return self.frame
        if not robot.layout.groups:
            seen = f"AerodynamicForce acts on a base that moves, and {robot.name} is fixed to the world"
            raise InvalidInput(f"{seen}; read it with base='floating', or name a link: frame=...")
        body = robot.layout.groups[0].bodies.stop - 1
        return next(name for name in robot.link_names if robot.frame(name)[0] == body)

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return tuple(f"{what}-{axis}" for what in ("force", "torque") for axis in "xyz")

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return ("N",) * 3 + ("Nm",) * 3

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        where = self._point(dynamics)
        parts = where.jacobian[..., :3, :], where.jacobian[..., 3:, :]
        return torch.cat([part.mT @ where.orientation for part in parts], dim=-1)

    @override
    def point_force(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch 3 C"]:
        axes = self._point(dynamics).orientation
        return torch.cat([axes, torch.zeros_like(axes)], dim=-1)

    @override
    def columns(self, dynamics: ConstrainedDynamics) -> dict[str, Callable[[], Tensor]]:
        state, where = dynamics.state, self._point(dynamics)
        moving, turning = where.velocity(state.v).split(3, dim=-1)
        flow = state.v.new_tensor(self.wind) if (wind := ObservedWind.at(state)) is None else wind
        linear, angular = ((where.orientation.mT @ part[..., None])[..., 0] for part in (moving - flow, turning))
        groups = state.robot.layout.groups

        def push() -> Tensor:
            """Of actuators on a base that flies, without x and y, which none drives; else of all joints."""
            return state.delivered[..., groups[0].rows][..., 2:] if groups else state.delivered

        def root_of_thrust() -> Tensor:
            thrust = push()[..., :1] if groups else push()
            return (thrust.square().sum(-1, keepdim=True) + 1e-4).sqrt().sqrt()  # smooth where rotors stand

        return {
            "velocity": lambda: linear,
            "drag": lambda: (linear.square().sum(-1, keepdim=True) + 1e-12).sqrt() * linear,
            "rotor-drag": lambda: root_of_thrust() * linear,
            "angular-velocity": lambda: angular,
            "thrust": push,
            "height": lambda: where.position[..., 2:],
            "attitude": lambda: where.orientation.flatten(-2),
        }

    @override
    def labels(self, robot: Robot) -> dict[str, Sequence[str]]:
        link, groups = self.link(robot), robot.layout.groups
        parts = VELOCITIES if groups else robot.joint_names
        units = ["N" if part in "xyz" else "Nm" for part in parts]
        pushes = [f"actuation along {part} [{unit}]" for part, unit in zip(parts, units, strict=True)]
        return {
            "velocity": [f"velocity of {link} along its {axis} [m/s]" for axis in "xyz"],
            "drag": [f"speed times velocity of {link} along its {axis} [m^2/s^2]" for axis in "xyz"],
            "rotor-drag": [f"root of thrust times velocity of {link} along its {axis} [N^1/2 m/s]" for axis in "xyz"],
            "angular-velocity": [f"angular velocity of {link} about its {axis} [rad/s]" for axis in "xyz"],
            "thrust": pushes[2:] if groups else pushes,
            "height": [f"height of {link} [m]"],
            "attitude": [f"world {world} along {axis} of {link}" for world in "xyz" for axis in "xyz"],
        }

    def _point(self, dynamics: ConstrainedDynamics) -> ToolPoint:
        return ToolPoint.of(dynamics, self.link(dynamics.state.robot), (0.0, 0.0, 0.0))
