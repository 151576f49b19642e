"""What actuators deliver, what thrusters and cables do to a link, what observers estimate; what robot files state."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, require_type
from forcegp.forces.force import Coefficient, Force, Law, Number, as_numbers
from forcegp.forces.joint_law import PerJointLaw
from forcegp.forces.joint_laws import Coulomb, Spring, Viscous
from forcegp.forces.rigid_bodies import RigidBodies, WholeLaw
from forcegp.mechanics.gauss_principle import State
from forcegp.robots import Robot
from forcegp.robots.arguments import finite_vector
from forcegp.robots.mjcf_model import Translation


@dataclass(frozen=True, eq=False)
class Actuation(PerJointLaw):
    """What the actuators deliver: gain (`matrix` u) with `matrix` (nv, nu), one column per actuator, called `names`.

    Without a matrix there is one actuator per joint of one degree of freedom, u = its force; bases that move have none.
    `gain` is a factor per joint: 1 where u is what arrives there; a prior, such as LogNormal(1, .2), where drives are
    calibrated badly; None where u is a current, a percentage or ticks, whose constants nobody knows. With `known` False
    what they do is left to the unknown forces.
    """

    matrix: Sequence[Sequence[float]] | np.ndarray | Tensor | None = None
    names: tuple[str, ...] = ()
    known: bool = True
    gain: Number = 1.0
    coefficients: ClassVar[Mapping[str, Coefficient]] = {
        "gain": Coefficient("1", 1.0, factor=1.0, lowest=1e-6, highest=1e6, logarithm=True)
    }
    called: ClassVar[str] = "gain"
    in_gear: ClassVar[bool] = True

    def __post_init__(self) -> None:
        require_type("Actuation known", self.known, bool)

    @override
    def bound_to(self, robot: Robot) -> "Actuation":
        gain = self.gain if self.is_exact else self._bound("gain", robot)
        if self.matrix is None:
            one = torch.eye(robot.nv, dtype=torch.float64, device=robot.device)
            matrix = one[:, robot.space.single_rows] if robot.layout.groups else None
            return Actuation(matrix, robot.single_joint_names, self.known, gain)
        matrix = as_numbers("Actuation matrix", self.matrix, robot, f"{robot.nv} rows of numbers")
        names = tuple(self.names) or tuple(f"actuator_{k + 1}" for k in range(matrix.shape[-1] if matrix.dim() else 0))
        if matrix.dim() != 2 or len(matrix) != robot.nv or not bool(torch.isfinite(matrix).all()):
            seen = f"Actuation matrix has shape {tuple(matrix.shape)}"
            rows = f"{robot.nv} rows, one per degree of freedom: {', '.join(robot.joint_names)}"
            raise InvalidInput(f"{seen}; {robot.name} needs finite numbers in {rows}.")
        if len(names) != matrix.shape[1] or len(set(names)) != len(names):
            raise InvalidInput(f"Actuation names are {names}; give {matrix.shape[1]} different ones, one per column.")
        return Actuation(matrix, names, self.known, gain)

    @property
    def is_exact(self) -> bool:
        """Whether u is taken as what arrives at the joints."""
        return isinstance(self.gain, int | float) and self.gain == 1

    def stated(self, state: State) -> Tensor:
        """Joint forces (..., nv) as u states them, before gains."""
        u = state.u[..., : len(self.names)]
        return u if self.matrix is None else u @ torch.as_tensor(self.matrix).mT

    def delivered(self, state: State) -> Tensor:
        """Joint forces (..., nv) of the actuators."""
        return self.stated(state) if self.is_exact else self.values["gain"].to(state.u.device) * self.stated(state)

    @override
    def features(self, state: State) -> tuple[Tensor, ...]:
        return (self.stated(state),)

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        if not self.known:
            return torch.zeros_like(features[0])
        return features[0] if self.is_exact else parameters["gain"] * features[0]

    @override
    def acts_on(self, name: str, robot: Robot) -> Bool[np.ndarray, " nv"]:
        if self.matrix is None:
            return np.full(robot.nv, self.known)
        return self.known & (torch.as_tensor(self.matrix) != 0.0).any(1).cpu().numpy()


class LinkForce(Law):
    """A force and a torque on the link `frame` that follow from columns of u called `names`.

    Amplitudes are the force [N], then the torque [Nm] about the origin of the link, in the link's axes.
    """

    frame: str

    @override
    def direction(self, state: State) -> Float[Tensor, "*batch nv 6"]:
        axes, J = state.kinematics.frame_pose(self.frame)[..., :3, :3], state.kinematics.frame_jacobian(self.frame)
        return torch.cat([part.mT @ axes for part in J.split(3, dim=-2)], dim=-1)

    @override
    def features(self, state: State) -> tuple[Tensor, ...]:
        """Columns of u, and the axes of the link."""
        first = state.inputs.index(self.names[0])
        return state.u[..., first : first + len(self.names)], state.kinematics.frame_pose(self.frame)[..., :3, :3]


@dataclass(frozen=True, eq=False)
class Thrusters(LinkForce):
    """Thruster k at `places[k]` (m) pushes link `frame` along `axes[k]`: thrust[k] s, and torque[k] s about it.

    s = u for `power` 1 (a thrust, or a share of it) and u |u| for `power` 2 (a rotor's speed). `thrust` in N and
    `torque` in Nm per unit of s, positive for a torque on the link along the axis; one number, or one each. Columns of
    u are called `names`. With `known` False what they do is left to the unknown forces.
    Source: Mahony, Kumar & Corke, "Multirotor aerial vehicles", IEEE RAM 2012. InvalidInput for what does not fit.
    """

    frame: str
    places: Sequence[Sequence[float]] | Tensor
    thrust: float | Sequence[float] | Tensor = 1.0
    torque: float | Sequence[float] | Tensor = 0.0
    axes: Sequence[float] | Sequence[Sequence[float]] | Tensor = (0.0, 0.0, 1.0)
    power: int = 1
    names: tuple[str, ...] = ()
    known: bool = True

    @classmethod
    def of_wrench(cls, frame: str, wrench: Sequence[float], name: str) -> "Thrusters":
        """One that does this per unit of u: force [N], and torque [Nm] about the origin of the link, in its axes."""
        force, torque = np.split(np.array(wrench), 2)
        thrust = float(np.linalg.norm(force))
        along = force if thrust else torque
        axis = along / np.linalg.norm(along) if along.any() else np.array([0.0, 0.0, 1.0])
        place = np.cross(axis, torque) / thrust if thrust else np.zeros(3)  # a lever makes the rest
        return cls(frame, [place.tolist()], thrust, float(torque @ axis), axis.tolist(), names=(name,))

    @override
    def bound_to(self, robot: Robot) -> "Thrusters":
        robot.frame(self.frame)
        places = _numbers("places", self.places, robot)
        if places.dim() != 2 or places.shape[-1] != 3 or not len(places):
            raise InvalidInput(f"Thrusters places are {self.places!r}; give x, y, z in m for each thruster.")
        count = len(places)
        axes = _fitting("axes", self.axes, (count, 3), robot)
        length = torch.linalg.vector_norm(axes, dim=-1, keepdim=True)
        if not bool((length > 0).all()):
            raise InvalidInput(f"Thrusters axes are {self.axes!r}; give a direction for each thruster.")
        if self.power not in (1, 2):
            raise InvalidInput(f"Thrusters power is {self.power!r}; give 1 for thrusts or 2 for rotor speeds.")
        thrust, torque = (_fitting(name, getattr(self, name), (count,), robot) for name in ("thrust", "torque"))
        names = tuple(self.names) or tuple(f"rotor_{k + 1}" for k in range(count))
        if len(names) != count or len(set(names)) != count:
            raise InvalidInput(f"Thrusters names are {names}; give {count} different ones, one for each thruster.")
        return Thrusters(self.frame, places, thrust, torque, axes / length, int(self.power), names, self.known)

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        wrench = self._wrench(features[0])
        return wrench if self.known else torch.zeros_like(wrench)

    def delivered(self, state: State) -> Tensor:
        """Joint forces (..., nv) that they make, known or not."""
        return (self.direction(state) @ self._wrench(self.features(state)[0])[..., None])[..., 0]

    def _wrench(self, u: Tensor) -> Tensor:
        s = u if self.power == 1 else u * u.abs()
        places, axes, thrust, torque = (torch.as_tensor(x) for x in (self.places, self.axes, self.thrust, self.torque))
        turning = thrust[:, None] * torch.linalg.cross(places, axes) + torque[:, None] * axes
        return s @ torch.cat([thrust[:, None] * axes, turning], dim=-1)


@dataclass(frozen=True, eq=False)
class Pull(Law):
    """A constant force (x, y, z) in N along the world's axes on link `frame`, at a `point` of it in m: a hose, a cable.

    The joint force is J(point)^T (x, y, z). Raises InvalidInput for what does not fit.
    """

    frame: str
    x: Number = None
    y: Number = None
    z: Number = None
    point: Any = (0.0, 0.0, 0.0)
    coefficients: ClassVar[Mapping[str, Coefficient]] = {x: Coefficient("N", 0.0, 100.0, lowest=-np.inf) for x in "xyz"}

    @override
    def bound_to(self, robot: Robot) -> "Pull":
        robot.frame(self.frame)
        return replace(self, point=tuple(finite_vector("Pull point", self.point, 3, " x, y, z in m").tolist()))

    @override
    def direction(self, state: State) -> Float[Tensor, "*batch nv 3"]:
        return state.kinematics.frame_jacobian(self.frame, self.point)[..., :3, :].mT

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        rows = features[0].shape[:-1]
        return torch.cat([parameters[axis].expand(*rows, 1) for axis in "xyz"], dim=-1)


@dataclass(frozen=True, eq=False)
class ObservedWrench(LinkForce):
    """A slow force on link `frame` that an observer estimates from the past, as wind makes it; columns of u hold it.

    `names`: a force [N] and a torque [Nm] about the origin of the link, along the world's axes
    (`forcegp.posterior.observing`).
    """

    frame: str
    names: tuple[str, ...] = tuple(f"observed_{what}_{axis}" for what in ("force", "torque") for axis in "xyz")

    @override
    def bound_to(self, robot: Robot) -> "ObservedWrench":
        robot.frame(self.frame)
        if len(self.names) != 6 or len(set(self.names)) < 6:
            raise InvalidInput(f"ObservedWrench names are {self.names}; give 6 different ones.")
        return ObservedWrench(self.frame, tuple(self.names))

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        u, axes = features
        return (axes.mT[..., None, :, :] @ u.unflatten(-1, (2, 3))[..., None]).flatten(-3)


@dataclass(frozen=True, eq=False)
class ObservedWind(WholeLaw):
    """The velocity of the air [m/s] along the world's axes, which an observer estimates, in columns of u.

    It is no force: `AerodynamicForce` takes velocities against it.
    """

    names: Any = ("wind_velocity_x", "wind_velocity_y", "wind_velocity_z")

    @classmethod
    def at(cls, state: State) -> Float[Tensor, "*batch 3"] | None:
        """The wind of these states; None where their system has no such columns."""
        if cls.names[0] not in state.inputs:
            return None
        first = state.inputs.index(cls.names[0])
        return state.u[..., first : first + 3]


OBSERVED = (ObservedWrench, ObservedWind)


def _numbers(name: str, given: object, robot: Robot) -> Tensor:
    values = as_numbers(f"Thrusters {name}", given, robot, "numbers")
    if not bool(torch.isfinite(values).all()):
        raise InvalidInput(f"Thrusters {name} is {given!r}; give finite numbers.")
    return values


def _fitting(name: str, given: object, shape: tuple[int, ...], robot: Robot) -> Tensor:
    values = _numbers(name, given, robot)
    try:
        return values.expand(shape).clone()
    except RuntimeError:
        seen = f"Thrusters {name} has shape {tuple(values.shape)}"
        raise InvalidInput(f"{seen}; give one for all, or {shape[0]}, one for each thruster.") from None


def forces_of_file(robot: Robot) -> tuple[Force, ...]:
    """What a robot's file states: actuation, rigid bodies, and joint damping and dry friction where it has them."""
    named = {joint.name: joint for joint in robot.joints if joint.name in robot.single_joint_names}
    damping = {name: joint.damping for name, joint in named.items() if joint.damping}
    friction = {name: joint.friction for name, joint in named.items() if joint.friction}
    laws = ((Viscous(damping),) if damping else ()) + ((Coulomb(friction),) if friction else ())
    return (Actuation(), RigidBodies(), *laws)


def forces_of_mjcf(robot: Robot, found: Translation) -> tuple[Force, ...]:
    """The same and springs; u are joint forces, or the inputs of all motors where some act elsewhere.

    Those of bodies that are not free come last.
    """
    actuation, moving = Actuation(), set(robot.joint_names)  # without those that are locked
    motors = [each for each in found.motors if moving & set(each.column)]
    pushing = [each for each in found.motors if each.link and robot.frame(each.link)[0] >= 0]
    if pushing or any(moving & set(each.column) - set(robot.single_joint_names) for each in motors):
        matrix = [[each.column.get(joint, 0.0) for each in motors] for joint in robot.joint_names]
        actuation = Actuation(matrix, tuple(each.name for each in motors))
    thrusters = (Thrusters.of_wrench(each.link, each.wrench, each.name) for each in pushing)
    sprung = {name: each for name, each in found.springs.items() if name in moving}
    stiffness, rest = ({name: each[k] for name, each in sprung.items()} for k in (0, 1))
    return (actuation, *thrusters, *forces_of_file(robot)[1:], *((Spring(stiffness, rest),) if sprung else ()))
