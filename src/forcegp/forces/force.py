"""`Force`: one class for all that acts on the joints; `Law`: a force known but for a few numbers; priors on them.

Q(x) = sum_k B_k(x) g_k(z_k(x, s)), with directions B, features z, amplitudes g and perhaps a state s that remembers. A
new law is one subclass with `features` and `amplitude` and an entry in `forcegp.forces.FORCES`.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from forcegp.errors import InvalidInput, require_number, usable_arguments
from forcegp.mechanics.gauss_principle import Contact, State
from forcegp.robots import Robot

UNITS = {
    "force": ("Nm", "N"),
    "position": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
    "acceleration": ("rad/s^2", "m/s^2"),
    "inertia": ("kg m^2", "kg"),
    "force/velocity": ("Nm s/rad", "N s/m"),
    "force/position": ("Nm/rad", "N/m"),
    "1": ("1", "1"),
}
"""Of coefficients, for joints that turn and joints that slide."""


@dataclass(frozen=True)
class Coefficient:
    """One number in a law, or one per joint.

    unit: a key of `UNITS`, a quotient such as "force/velocity^2" of the four quantities that it names, or a unit.
    default: the value where the law is given and this number is not, and where the search for it begins.
    factor: its typical size, in a log in which forces, positions, velocities and inertias are of size 1.
    lowest, highest: the least and largest value; with `logarithm` as multiples of the typical size.
    logarithm: whether it is positive, and estimated on a log scale.
    """

    unit: str = "force"
    default: float = 0.0
    factor: float = 0.1
    lowest: float = 0.0
    highest: float = np.inf
    logarithm: bool = False

    def size(self, typical: Mapping[str, Float[np.ndarray, " nv"]]) -> Float[np.ndarray, " nv"]:
        """`factor` times the unit, where "force", "position", "velocity" and "inertia" have these sizes."""
        size = np.full_like(typical["force"], self.factor)
        upper, *lower = self.unit.split("/")
        for part, sign in ((upper, 1.0), *((each, -1.0) for each in lower)):
            name, _, power = part.partition("^")
            size = size * typical[name] ** (sign * float(power or 1.0)) if name in typical else size
        return size


def joint_unit(unit: str, slides: bool) -> str:
    """The unit of a coefficient at a joint that turns, or slides."""
    if unit in UNITS:
        return UNITS[unit][slides]
    parts = [each.partition("^") for each in unit.split("/")]
    return "/".join(f"{UNITS[name][slides] if name in UNITS else name}{hat}{power}" for name, hat, power in parts)


@dataclass(frozen=True)
class Normal:
    """A number to be estimated, around `mean`; `std` of None is a weak prior: ten times its typical size in a log.

    Both are one number, one per joint, or by joint name. Where std is 0 the number is known, where nan the prior weak.
    """

    mean: Any = 0.0
    std: Any = None


@dataclass(frozen=True)
class LogNormal:
    """A positive number to be estimated: its logarithm is around that of `median`, with deviation `spread`."""

    median: Any
    spread: Any = 1.0


@dataclass(frozen=True)
class Body:
    """The ten parameters of a rigid body to be estimated, which stays physically possible (log-Cholesky).

    strength: weight w of the prior w/2 d^2 about the body that is given, with d the affine-invariant distance of bodies
        (one heavier throughout by a factor e costs 2 w; Lee, Wensing & Park, T-RO 2020).
    """

    strength: float = 1.0

    @usable_arguments("Body")
    def __post_init__(self) -> None:
        require_number("Body strength", self.strength, "it must be > 0, since data never determine all of a body")


@dataclass(frozen=True)
class Parameter:
    """One number of a model: its name, unit, where the search begins, and its prior; `prior` of None: it is known."""

    name: str
    unit: str
    start: float
    prior: Normal | LogNormal | Body | None


def per_joint(name: str, joints: Sequence[str]) -> tuple[str, ...]:
    """`name.joint` of every joint."""
    return tuple(f"{name}.{joint}" for joint in joints)


Joints = Float[Tensor, "*batch nv"]
Remembered = Float[Tensor, "*batch m"]


def _times(T: Float[Tensor, "nv nv"], x: Joints) -> Joints:
    return (T @ x[..., None])[..., 0]


PerJoint = float | Sequence[float] | Mapping[str, float] | np.ndarray | Tensor
Number = PerJoint | Normal | LogNormal | None
"""A number of a law: given (one, one per joint, or by joint name), or estimated under a prior; None: a weak one."""
AnyForce = TypeVar("AnyForce", bound="Force")
AnyLaw = TypeVar("AnyLaw", bound="Law")


class Force(ABC):  # noqa: B024  # laws and unknown forces have their own
    """What acts on the joints of a robot."""

    names: tuple[str, ...] = ()
    """Columns of u that belong to this force."""

    @property
    def title(self) -> str:
        """What the force is called where forces are listed, for example "joint-friction"."""
        return re.sub(r"(?<!^)(?=[A-Z])", "-", type(self).__name__).lower()

    def bound_to(self: AnyForce, robot: Robot) -> AnyForce:
        """The same with its numbers checked and in the order of the robot's joints."""
        return self

    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        """Raise InvalidInput where this force means nothing: on a frame or contact that is not there."""
        return

    def to_dict(self) -> dict[str, Any]:
        """The fields of a dataclass as plain JSON values, without those that are None."""
        given = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]  # forces are dataclasses
        return {name: plain(value) for name, value in given.items() if value is not None}


def plain(value: Any) -> Any:
    """A field of a force as JSON values, which `forcegp.forces.force_from_dict` turns back."""
    if isinstance(value, Normal | LogNormal):
        return {type(value).__name__: {f.name: plain(getattr(value, f.name)) for f in fields(value)}}
    if isinstance(value, Tensor | np.ndarray):
        return plain(torch.as_tensor(value).detach().tolist())
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, float) and value != value:  # the weak prior of a joint; JSON has no nan
        return None
    return [plain(entry) for entry in value] if isinstance(value, tuple | list) else value


class Law(Force):
    """A force that is known but for its coefficients. A subclass is a frozen dataclass with a field for each of these.

    The first coefficient decides: a law that is given it is known, and other coefficients that are not given have their
    defaults. A law that is not given it is estimated by `forcegp.fit`, with all coefficients that are not given.
    """

    coefficients: ClassVar[Mapping[str, Coefficient]] = {}
    """Its numbers by the names of their fields."""
    under_load: ClassVar[bool] = False
    """Whether it depends on the torque of the actuators, `State.delivered`, and grows in proportion to its size."""
    called: ClassVar[str] = ""
    """What its numbers are called; "" where that is the name of the law."""
    part: ClassVar[str] = ""
    """What of the robot it is a law of: those of one part take the place of each other, "" is that of its class."""
    in_gear: ClassVar[bool] = False
    """Whether it acts at the motor's side of a torque sensor at the link."""
    transmission: Any = None
    """Of motors in which it acts; None: it acts at the joints."""

    @classmethod
    def takes_the_place_of(cls, other: Force) -> bool:
        """Whether a model that gets this law loses the other one."""
        return isinstance(other, Law) and (type(other) is cls or cls.part == other.part != "")

    def direction(self, state: State) -> Float[Tensor, "*#batch nv k"] | None:
        """B: joint force (Nm or N) per unit of each amplitude; None where the amplitudes are the joint forces."""
        return None

    def features(self, state: State) -> tuple[Float[Tensor, "*batch _"], ...]:
        """z: what the amplitudes depend on; velocities where a subclass has nothing else."""
        return (state.v,)

    @abstractmethod
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Float[Tensor, "*batch k"]:
        """g(z) at coefficients by name, in torch operations; its sign is that which accelerates."""

    def force(self, state: State) -> Float[Tensor, "*#batch nv"]:
        """Joint force (..., nv) in Nm or N, with the sign that accelerates the joint."""
        return self.force_at(state, self.values)

    def force_at(self, state: State, values: Mapping[str, Tensor]) -> Float[Tensor, "*#batch nv"]:
        """`force` at other coefficients."""
        amplitude, B = self.amplitude(self.features(self.seen(state)), values), self.direction(state)
        return amplitude if B is None else (B @ amplitude[..., None])[..., 0]

    def seen(self, state: State) -> State:
        """The state as `features` are to see it."""
        return state

    def turning(self, motion: Joints) -> Joints:
        """Velocities or displacements of the motors, where joints have these."""
        return motion if self.transmission is None else _times(torch.as_tensor(self.transmission), motion)

    def at_motors(self, forces: Joints) -> Joints:
        """What motors deliver that make these joint forces."""
        if self.transmission is None:
            return forces
        return _times(torch.linalg.inv(torch.as_tensor(self.transmission)).mT, forces)

    def at_joints(self, forces: Joints) -> Joints:
        """Joint forces of motors that deliver these."""
        return forces if self.transmission is None else _times(torch.as_tensor(self.transmission).mT, forces)

    def inertia_basis(self, robot: Robot) -> Float[Tensor, "k nv nv"] | None:
        """What one unit of each first coefficient adds to the mass matrix, beside no amplitude; else None."""
        return None

    def added_inertia(self, robot: Robot) -> Float[Tensor, "nv nv"] | None:
        """What this adds to the mass matrix, in kg m^2 or kg."""
        if (basis := self.inertia_basis(robot)) is None:
            return None
        return torch.tensordot(self.values[next(iter(self.coefficients))].expand(len(basis)), basis, 1)

    def memory_names(self, robot: Robot) -> tuple[str, ...]:
        """Names of the numbers that it remembers from the motion before, columns of u; none for most laws."""
        return ()

    def memory_joints(self, robot: Robot) -> Sequence[int] | None:
        """The joints whose velocities tell the sign of each of these numbers; None where none does."""
        return None

    def remembered(self, state: State) -> Remembered:
        """What it remembers at these states."""
        names = self.memory_names(state.robot)
        first = state.inputs.index(names[0])
        return state.u[..., first : first + len(names)]

    def remember(self, memory: Remembered, step: Tensor, dt: float | Tensor) -> Remembered:
        """The memory after a `step` (..., nv) of the joints in dt: exact, differentiable, linear in each number."""
        return memory

    def past_of(self, strokes: Float[Tensor, "*batch nv strokes"]) -> Remembered:
        """The memory after displacements of the joints, the last one first."""
        raise NotImplementedError(f"{type(self).__name__} remembers, and has no `past_of`")

    @property
    def values(self) -> dict[str, Tensor]:
        """Coefficients by name; of those that are to be estimated the start: what a prior expects, else a default."""
        found = {}
        for name, coefficient in self.coefficients.items():
            given = getattr(self, name)
            given = given.mean if isinstance(given, Normal) else given.median if isinstance(given, LogNormal) else given
            found[name] = torch.as_tensor(coefficient.default if given is None else given, dtype=torch.float64)
        return found

    @property
    def learned(self) -> tuple[str, ...]:
        """Names of the coefficients that a fit estimates."""
        given = {name: getattr(self, name) for name in self.coefficients}
        free = {name for name, value in given.items() if value is None or isinstance(value, Normal | LogNormal)}
        open_ = set(list(given)[:1]) <= free  # what has no first coefficient, or states none
        return tuple(name for name, value in given.items() if name in free and (value is not None or open_))

    def with_values(self: AnyLaw, values: Mapping[str, Any]) -> AnyLaw:
        """The same law with these coefficients, which are known then."""
        return replace(self, **values)  # type: ignore[type-var]  # laws are dataclasses

    def open(self: AnyLaw, stated: AnyLaw | None = None) -> AnyLaw:
        """The same law with all coefficients to be estimated, from the values that they have.

        But those which a law that was `stated` knows by a standard deviation of 0.
        """
        opened = {}
        for name, value in self.values.items():
            given = None if stated is None else getattr(stated, name)
            std = None
            if isinstance(given, Normal) and given.std is not None:
                std = torch.where(torch.as_tensor(given.std, dtype=torch.float64) == 0.0, 0.0, torch.nan)
            opened[name] = Normal(value, std)
        return self.with_values(opened)

    def acts_on(self, name: str, robot: Robot) -> Bool[np.ndarray, " nv"]:
        """In which joints a coefficient does anything, so that data can tell it."""
        return np.ones(robot.nv, dtype=bool)

    def unit(self, name: str, joint: str, robot: Robot) -> str:
        """Of a coefficient, at a joint that turns or slides."""
        return joint_unit(self.coefficients[name].unit, joint in robot.joint_names and slides(joint, robot))


def slides(joint: str, robot: Robot) -> bool:
    """Whether a joint is prismatic."""
    return any(each.name == joint and each.type == "prismatic" for each in robot.joints)


def as_numbers(name: str, given: Any, robot: Robot, remedy: str) -> Tensor:
    """A tensor in float64 on the robot's device. Raises InvalidInput, with what to give, for what has no numbers."""
    try:
        return torch.as_tensor(given, dtype=torch.float64, device=robot.device)
    except (TypeError, ValueError, RuntimeError):
        raise InvalidInput(f"{name} is {given!r}; give {remedy}.") from None


class Memory:
    """The numbers that all laws of a model remember, side by side; `names` are their columns of u."""

    def __init__(self, forces: Sequence[Force], robot: Robot) -> None:
        laws = [force for force in forces if isinstance(force, Law)]
        self._laws = [(law, len(names)) for law in laws if (names := law.memory_names(robot))]
        self.robot = robot
        self.names = tuple(name for law, _ in self._laws for name in law.memory_names(robot))

    @property
    def titles(self) -> tuple[str, ...]:
        """The laws that remember."""
        return tuple(law.title for law, _ in self._laws)

    @property
    def transmission(self) -> Tensor | None:
        """Of the motors whose strokes they remember; None: joints."""
        return next((law.transmission for law, _ in self._laws), None)

    def likely(
        self, v: Float[Tensor, "n nv"], seen: Float[Tensor, "N m"], seen_v: Float[Tensor, "N nv"]
    ) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m"]]:
        """Mean and variance of the memory at velocities whose past is not known, as it was in rows that were `seen`."""
        signs, seen_signs = torch.ones(len(v), len(self.names)).to(v), torch.ones_like(seen)
        first = 0
        for law, size in self._laws:
            if (joints := law.memory_joints(self.robot)) is not None:
                own = slice(first, first + size)
                here, there = (law.turning(each)[:, list(joints)].sign() for each in (v, seen_v))
                signs[:, own], seen_signs[:, own] = here, there
            first += size
        mean = (seen * seen_signs).mean(0)
        variance = torch.where(signs == 0.0, seen.square().mean(0), (seen * seen_signs - mean).square().mean(0))
        return mean * signs, variance

    def after(self, memory: Remembered, step: Joints, dt: float | Tensor) -> Tensor:
        """The memory after the joints have moved by `step` in dt."""
        parts = memory.split([size for _, size in self._laws], dim=-1)
        return torch.cat([law.remember(x, step, dt) for (law, _), x in zip(self._laws, parts, strict=True)], dim=-1)

    def past_of(self, strokes: Float[Tensor, "*batch nv strokes"]) -> Remembered:
        """The memory after these displacements of the joints, the last one first."""
        return torch.cat([law.past_of(strokes) for law, _ in self._laws], dim=-1)
