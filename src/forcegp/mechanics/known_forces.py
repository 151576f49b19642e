"""Known joint forces as explicit objects: Q_K is the sum of what is listed, and nothing else.

A new known force is one subclass with a `force`, and an entry in `KNOWN_FORCES` so that files can carry it.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.mechanics.gauss_principle import State
from forcegp.robots import Robot
from forcegp.robots.arguments import by_joint

PerJoint = float | Sequence[float] | Mapping[str, float] | Tensor


def as_numbers(name: str, given: Any, robot: Robot, remedy: str) -> Tensor:
    """A tensor in float64 on the robot's device. Raises InvalidInput, with what to give, for what has no numbers."""
    try:
        return torch.as_tensor(given, dtype=torch.float64, device=robot.device)
    except (TypeError, ValueError, RuntimeError):
        raise InvalidInput(f"{name} is {given!r}; give {remedy}.") from None


class KnownForce(ABC):
    """A joint force that the model takes as given."""

    per_joint: ClassVar[tuple[str, ...]] = ()
    """Names of the fields with one number per joint."""

    positive: ClassVar[tuple[str, ...]] = ()
    """Those of them that must be > 0."""

    signed: ClassVar[tuple[str, ...]] = ()
    """Those of them that may be negative; all others must be >= 0."""

    learned: ClassVar[str | None] = None
    """Name of the one of them that an identification estimates."""

    @abstractmethod
    def force(self, state: State) -> Float[Tensor, "*#batch nv"]:
        """Joint force (..., nv) in Nm or N, with the sign that accelerates the joint."""

    def added_inertia(self) -> Float[Tensor, "nv nv"] | None:
        """What this adds to the mass matrix, in kg m^2 or kg."""
        return None

    def bound_to(self, robot: Robot) -> "KnownForce":
        """The same with per-joint numbers as tensors (nv,) in the order of robot.joint_names, checked."""
        if not self.per_joint:
            return self
        bound = {name: self._bound(name, robot) for name in self.per_joint}
        return type(self)(**{f.name: bound.get(f.name, getattr(self, f.name)) for f in fields(self)})  # type: ignore[arg-type]  # forces with numbers are dataclasses

    def _bound(self, name: str, robot: Robot) -> Tensor:
        what = f"{type(self).__name__} {name}"
        given = by_joint(getattr(self, name), robot.joint_names, robot.name)
        values = as_numbers(what, given, robot, "a number, one per joint, or a mapping from joint names")
        if values.dim() == 0:  # one number for every joint, but not for bases that move
            driven = [joint in robot.single_joint_names or name in self.positive for joint in robot.joint_names]
            values = values * torch.tensor(driven, dtype=values.dtype, device=values.device)
        values = values.clone()  # which keeps the graph
        if values.shape != (robot.nv,):
            raise InvalidInput(
                f"{what} has {tuple(values.shape)} values; {robot.name} has {robot.nv} joints: "
                f"{', '.join(robot.joint_names)}"
            )
        if not bool(torch.isfinite(values).all()):
            raise InvalidInput(f"{what} is {values.tolist()}; every joint needs a finite number.")
        if name in self.signed:
            return values
        if name in self.positive and not bool((values > 0).all()):
            raise InvalidInput(f"{what} is {values.tolist()}; it must be positive for every joint.")
        if not bool((values >= 0).all()):
            raise InvalidInput(f"{what} is {values.tolist()}; every joint needs a finite number >= 0.")
        return values


@dataclass(frozen=True, eq=False)
class Actuation(KnownForce):
    """What the actuators deliver: `matrix` u with `matrix` (nv, nu), one column per actuator, called `names`.

    Without a matrix there is one actuator per joint of one degree of freedom, u = its force; bases that move have none.
    Couplings and differentials are columns with several entries, without unit or in rad/rad.
    """

    matrix: Sequence[Sequence[float]] | np.ndarray | Tensor | None = None
    names: tuple[str, ...] = ()

    @override
    def bound_to(self, robot: Robot) -> "Actuation":
        if self.matrix is None:
            free = {row for group in robot.layout.groups for row in range(*group.rows.indices(robot.nv))}
            if not free:
                return Actuation(None, robot.joint_names)
            driven = [row for row in range(robot.nv) if row not in free]
            matrix = torch.eye(robot.nv, dtype=torch.float64, device=robot.device)[:, driven]
            return Actuation(matrix, tuple(robot.joint_names[row] for row in driven))
        matrix = as_numbers("Actuation matrix", self.matrix, robot, f"{robot.nv} rows of numbers")
        names = tuple(self.names) or tuple(f"actuator_{k + 1}" for k in range(matrix.shape[-1] if matrix.dim() else 0))
        if matrix.dim() != 2 or len(matrix) != robot.nv or not bool(torch.isfinite(matrix).all()):
            raise InvalidInput(
                f"Actuation matrix has shape {tuple(matrix.shape)}; {robot.name} needs finite numbers in {robot.nv} "
                f"rows, one per degree of freedom: {', '.join(robot.joint_names)}."
            )
        if len(names) != matrix.shape[1] or len(set(names)) != len(names):
            raise InvalidInput(f"Actuation names are {names}; give {matrix.shape[1]} different ones, one per column.")
        return Actuation(matrix, names)

    def delivered(self, u: Tensor) -> Tensor:
        """Joint forces (..., nv) of the actuator forces u (..., nu)."""
        return u if self.matrix is None else u @ torch.as_tensor(self.matrix).mT

    @override
    def force(self, state: State) -> Tensor:
        return self.delivered(state.u[..., : len(self.names)])


@dataclass(frozen=True, eq=False)
class RigidBodyBias(KnownForce):
    """Coriolis, centrifugal and gravity forces of the rigid bodies: -bias(q, v)."""

    @override
    def force(self, state: State) -> Tensor:
        return -state.kinematics.bias_forces(state.inertials)


@dataclass(frozen=True, eq=False)
class ViscousJointFriction(KnownForce):
    """-d v with d in Nms/rad or Ns/m: one number, one per joint, or by joint name (joints not named have none)."""

    coefficients: PerJoint
    per_joint: ClassVar[tuple[str, ...]] = ("coefficients",)
    learned: ClassVar[str | None] = "coefficients"

    @classmethod
    def from_robot(cls, robot: Robot) -> "ViscousJointFriction":
        """The <dynamics damping> of the URDF."""
        return cls([joint.damping for joint in robot.joints])

    @override
    def force(self, state: State) -> Tensor:
        return -self.coefficients * state.v  # type: ignore[operator]  # a tensor once it is bound


@dataclass(frozen=True, eq=False)
class CoulombJointFriction(KnownForce):
    """-c tanh(v / velocity_scale): dry friction of c Nm or N, smoothed below `velocity_scale` (rad/s or m/s)."""

    coefficients: PerJoint
    velocity_scale: PerJoint = 0.01
    per_joint: ClassVar[tuple[str, ...]] = ("coefficients", "velocity_scale")
    positive: ClassVar[tuple[str, ...]] = ("velocity_scale",)
    learned: ClassVar[str | None] = "coefficients"

    @classmethod
    def from_robot(cls, robot: Robot, velocity_scale: PerJoint = 0.01) -> "CoulombJointFriction":
        """The <dynamics friction> of the URDF."""
        return cls([joint.friction for joint in robot.joints], velocity_scale)

    @override
    def force(self, state: State) -> Tensor:
        return -self.coefficients * torch.tanh(state.v / self.velocity_scale)  # type: ignore[operator]  # tensors once they are bound


@dataclass(frozen=True, eq=False)
class StribeckJointFriction(KnownForce):
    """-(c + (s - c) exp(-(v / v_s)^2)) tanh(v / w): dry friction that falls from `static` to `coulomb` in motion.

    `coulomb` c and `static` s (break-away) in Nm or N, `stribeck_velocity` v_s and `velocity_scale` w in rad/s or m/s.
    Source: Olsson et al., "Friction models and friction compensation", Eur. J. Control (1998), eq. 4, with a smooth
    sign.
    """

    coulomb: PerJoint
    static: PerJoint
    stribeck_velocity: PerJoint
    velocity_scale: PerJoint = 0.01
    per_joint: ClassVar[tuple[str, ...]] = ("coulomb", "static", "stribeck_velocity", "velocity_scale")
    positive: ClassVar[tuple[str, ...]] = ("stribeck_velocity", "velocity_scale")

    @override
    def force(self, state: State) -> Tensor:
        c, s, v_s, w = (torch.as_tensor(getattr(self, name)) for name in self.per_joint)  # tensors once they are bound
        return -(c + (s - c) * torch.exp(-((state.v / v_s) ** 2))) * torch.tanh(state.v / w)


@dataclass(frozen=True, eq=False)
class LoadJointFriction(KnownForce):
    """-(c + mu |u|) tanh(v / w): dry friction of a gear, which grows with the torque that it transmits.

    `coefficients` mu without unit, `coulomb` c in Nm or N, `velocity_scale` w in rad/s or m/s. Source: Hamon, Gautier &
    Garrec, "Dynamic identification of robots with a dry friction model depending on load and velocity", IROS 2010,
    where the load is the output torque; here it is that of the actuator.
    """

    coefficients: PerJoint
    coulomb: PerJoint = 0.0
    velocity_scale: PerJoint = 0.01
    per_joint: ClassVar[tuple[str, ...]] = ("coefficients", "coulomb", "velocity_scale")
    positive: ClassVar[tuple[str, ...]] = ("velocity_scale",)
    learned: ClassVar[str | None] = "coefficients"

    @override
    def force(self, state: State) -> Tensor:
        mu, c, w = (torch.as_tensor(getattr(self, name)) for name in self.per_joint)  # tensors once they are bound
        return -(c + mu * state.delivered.abs()) * torch.tanh(state.v / w)


@dataclass(frozen=True, eq=False)
class ConstantJointForce(KnownForce):
    """A constant of either sign in Nm or N: the offset of a torque sensor, or friction that differs by direction."""

    values: PerJoint
    per_joint: ClassVar[tuple[str, ...]] = ("values",)
    signed: ClassVar[tuple[str, ...]] = ("values",)

    @override
    def force(self, state: State) -> Tensor:
        return torch.as_tensor(self.values).expand_as(state.v)


@dataclass(frozen=True, eq=False)
class DirectionalJointFriction(KnownForce):
    """-e |v| with e in Nms/rad or Ns/m, of either sign: viscous friction that differs by e from its mean by direction.

    With `ViscousJointFriction` d it is d + e forwards and d - e backwards; `ConstantJointForce` does the same for dry
    friction.
    """

    differences: PerJoint
    per_joint: ClassVar[tuple[str, ...]] = ("differences",)
    signed: ClassVar[tuple[str, ...]] = ("differences",)

    @override
    def force(self, state: State) -> Tensor:
        return -self.differences * state.v.abs()  # type: ignore[operator]  # a tensor once it is bound


@dataclass(frozen=True, eq=False)
class Armature(KnownForce):
    """Rotor inertia seen at the joint (kg m^2 or kg), added to the mass matrix on top of the robot's own `armature`."""

    inertia: PerJoint
    per_joint: ClassVar[tuple[str, ...]] = ("inertia",)
    learned: ClassVar[str | None] = "inertia"

    @override
    def force(self, state: State) -> Tensor:
        return torch.zeros_like(state.v)

    @override
    def added_inertia(self) -> Tensor:
        return torch.diag_embed(torch.as_tensor(self.inertia))


@dataclass(frozen=True, eq=False)
class RotorInertia(KnownForce):
    """Rotors that turn with several joints: T^T diag(I) T added to the mass matrix, for rotor speeds T v.

    `inertia` I holds one rotor per joint (kg m^2), `transmission` T (nv, nv) how fast each rotor turns about its axis,
    in a frame that does not, per joint velocity. One motor per joint, in the joint: T is diagonal and holds the gear
    ratios, for which `Armature` is shorter. A motor that sits on a moving link also turns with that link, and a
    differential couples two joints. With transmission None, T is the identity. Gyroscopic forces of the rotors are
    left out. Source: Murphy, Wen & Saridis, "Recursive calculation of geared robot manipulator dynamics", ICRA 1990.
    """

    inertia: PerJoint
    transmission: Sequence[Sequence[float]] | Tensor | None = None
    per_joint: ClassVar[tuple[str, ...]] = ("inertia",)
    learned: ClassVar[str | None] = "inertia"

    @override
    def bound_to(self, robot: Robot) -> KnownForce:
        given = torch.eye(robot.nv).tolist() if self.transmission is None else self.transmission
        matrix = as_numbers("RotorInertia transmission", given, robot, f"{robot.nv} rows of numbers")
        if matrix.shape != (robot.nv, robot.nv) or not bool(torch.isfinite(matrix).all()):
            raise InvalidInput(
                f"RotorInertia transmission has shape {tuple(matrix.shape)}; {robot.name} needs a finite matrix "
                f"({robot.nv}, {robot.nv}): a row per rotor, a column per joint {', '.join(robot.joint_names)}."
            )
        return RotorInertia(self._bound("inertia", robot), matrix)

    @override
    def force(self, state: State) -> Tensor:
        return torch.zeros_like(state.v)

    @override
    def added_inertia(self) -> Tensor:
        T = torch.as_tensor(self.transmission)
        return T.mT @ (torch.as_tensor(self.inertia)[:, None] * T)


KNOWN_FORCES: dict[str, type[KnownForce]] = {
    "actuation": Actuation,
    "rigid-body-bias": RigidBodyBias,
    "viscous-joint-friction": ViscousJointFriction,
    "coulomb-joint-friction": CoulombJointFriction,
    "stribeck-joint-friction": StribeckJointFriction,
    "load-joint-friction": LoadJointFriction,
    "constant-joint-force": ConstantJointForce,
    "directional-joint-friction": DirectionalJointFriction,
    "armature": Armature,
    "rotor-inertia": RotorInertia,
}
"""Known forces that files can carry, by the name they have there."""


def known_force_to_dict(force: KnownForce) -> dict[str, Any]:
    """Plain numbers for `object_from_dict`. Raises InvalidInput for a force that has no name in files."""
    name = next((name for name, kind in KNOWN_FORCES.items() if type(force) is kind), None)
    if name is None:
        raise InvalidInput(f"a {type(force).__name__} cannot be stored; files carry {', '.join(KNOWN_FORCES)}")
    stored: dict[str, Any] = {"type": name}
    for f in fields(force):  # type: ignore[arg-type]  # every entry of KNOWN_FORCES is a dataclass
        value = getattr(force, f.name)
        if isinstance(force, Actuation) and force.matrix is None:
            continue  # files of robots that are driven in every joint stay as they were
        plain = list(value) if f.name == "names" else value
        stored[f.name] = plain if isinstance(plain, list | str | int) else torch.as_tensor(value).tolist()
    return stored
