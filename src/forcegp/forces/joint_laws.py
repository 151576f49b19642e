"""Laws that act in every joint by itself: friction, offsets, springs, rotors; and what each needs of the torque."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.forces.force import Coefficient, Law, Number
from forcegp.forces.joint_law import JointLaw
from forcegp.forces.presliding import after_step, after_strokes
from forcegp.mechanics.gauss_principle import State
from forcegp.robots import Robot


@dataclass(frozen=True, eq=False)
class Viscous(JointLaw):
    """-d v with d in Nms/rad or Ns/m: one number, one per joint, or by joint name (joints not named have none)."""

    damping: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {"damping": Coefficient("force/velocity")}

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return -parameters["damping"] * features[0]


@dataclass(frozen=True, eq=False)
class DirectionalFriction(JointLaw):
    """-e |v| with e in Nms/rad or Ns/m, of either sign: viscous friction that differs by e from its mean by direction.

    With `Viscous` d it is d + e forwards and d - e backwards; `Offset` does the same for dry friction.
    """

    difference: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {"difference": Coefficient("force/velocity", lowest=-np.inf)}

    @override
    def features(self, state: State) -> tuple[Tensor, ...]:
        return (state.v.abs(),)

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return -parameters["difference"] * features[0]


DRY = "dry friction"
HIGHEST = 0.5  # largest share of the load that friction takes: beyond it something else is explained
NUMBERS = {
    "level": Coefficient(),
    "factor": Coefficient("1", highest=HIGHEST),
    "root": Coefficient("force/velocity^.5", lowest=-np.inf),
    "breakaway": Coefficient(),
    "stribeck_velocity": Coefficient("velocity", 0.1, 0.3, 0.1, 10.0, logarithm=True),
    "velocity_scale": Coefficient("velocity", 0.01, 0.1, 0.03, 20.0, logarithm=True),
    "sigma": Coefficient("1/position", 1000.0, 500.0, 0.02, 50.0, logarithm=True),
}
"""Of dry friction: of its level, of which a law has some, and of its sign, which all have."""
SIGN = ("velocity_scale", "sigma")


def of_friction(*more: str) -> dict[str, Coefficient]:
    """The coefficients of a law of dry friction whose level has these numbers, too."""
    return {name: NUMBERS[name] for name in ("level", *more, *SIGN)}


Memory = bool | tuple[str, ...] | tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class DryFriction(JointLaw):
    """-(level) s: dry friction, whose sign s is tanh(v / w), or with `memory` a state that remembers reversals.

    `velocity_scale` w in rad/s or m/s smooths the sign. With `memory` (True, or the names of the joints that have it)
    s is z of `forces.presliding`, which a reversal turns over a displacement of 1 / `sigma` (sigma in 1/rad or 1/m).
    """

    sigma: Number = field(default=None, kw_only=True)
    memory: Memory = field(default=False, kw_only=True)
    level: Number = None
    part: ClassVar[str] = DRY

    def level_at(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Float[Tensor, "*batch nv"]:
        """The friction of a joint that slides, from the velocity and what else `features` gives before the past.

        c + mu |u| + r sqrt|v| + b exp(-(v / v_s)^2), of which it has the terms whose numbers the law has.
        """
        v, level = features[0], parameters["level"]
        if "factor" in parameters:
            level = level + parameters["factor"] * features[1]
        if "root" in parameters:
            level = level + parameters["root"] * v.abs().sqrt()
        if "breakaway" in parameters:
            level = level + parameters["breakaway"] * torch.exp(-((v / parameters["stribeck_velocity"]) ** 2))
        return level

    @override
    def features(self, state: State) -> tuple[Tensor, ...]:
        own = (state.v, state.delivered.abs()) if self.under_load else (state.v,)
        if not self.memory:
            return own
        if state.strokes is not None:  # (..., nv, strokes), else the memory (..., nv)
            return (*own, state.strokes)
        z = iter(self.remembered(state).unbind(-1))
        past = [next(z) if remembers else 0.0 * state.v[..., j] for j, remembers in enumerate(self._mask)]
        return (*own, torch.stack(past, dim=-1))

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        v = features[0]
        s = torch.tanh(v / parameters["velocity_scale"])
        if self.memory:
            past = features[-1]
            z = past if past.dim() == v.dim() else after_strokes(past, parameters["sigma"])
            s = torch.stack([(z if own else s)[..., j] for j, own in enumerate(self._mask)], dim=-1)
        return -self.level_at(features, parameters) * s

    @override
    def bound_to(self, robot: Robot) -> "DryFriction":
        if self.memory is None:
            return super().bound_to(robot)
        given = self.memory if isinstance(self.memory, bool) else tuple(self.memory)
        single = np.isin(robot.joint_names, robot.single_joint_names)
        if isinstance(given, tuple) and not all(isinstance(each, bool) for each in given):
            if wrong := [name for name in given if name not in robot.single_joint_names]:
                own = ", ".join(robot.single_joint_names)
                raise InvalidInput(f"{type(self).__name__} memory names {wrong}; {robot.name} has {own}.")
            given = tuple(name in given for name in robot.joint_names)
        elif given is True:
            given = tuple(single.tolist())
        if isinstance(given, tuple) and len(given) != robot.nv:
            raise InvalidInput(f"{type(self).__name__} memory has {len(given)} entries; give names of joints.")
        return super(DryFriction, replace(self, memory=any(given) and given if given else False)).bound_to(robot)

    @override
    def acts_on(self, name: str, robot: Robot) -> Bool[np.ndarray, " nv"]:
        acts = super().acts_on(name, robot)
        return acts & (np.array(self._mask or [False] * robot.nv) == (name == "sigma")) if name in SIGN else acts

    @override
    def memory_names(self, robot: Robot) -> tuple[str, ...]:
        return tuple(f"presliding of {robot.joint_names[j]}" for j in self._places)

    @override
    def memory_joints(self, robot: Robot) -> list[int]:
        return self._places

    @override
    def remember(self, memory: Tensor, step: Tensor, dt: float | Tensor) -> Tensor:
        return after_step(memory, self.turning(step)[..., self._places], self._sigma(step)[self._places])

    @override
    def past_of(self, strokes: Tensor) -> Tensor:
        return after_strokes(strokes, self._sigma(strokes[..., 0]))[..., self._places]

    def _sigma(self, like: Tensor) -> Tensor:
        return self.values["sigma"].to(like.device).expand(like.shape[-1])

    @property
    def _mask(self) -> tuple[bool, ...]:
        """Of a bound law, which joints remember."""
        return self.memory if isinstance(self.memory, tuple) else ()  # type: ignore[return-value]  # it is bound

    @property
    def _places(self) -> list[int]:
        return [j for j, own in enumerate(self._mask) if own]


@dataclass(frozen=True, eq=False)
class Coulomb(DryFriction):
    """-c s: dry friction of `level` c in Nm or N."""

    velocity_scale: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = of_friction()


@dataclass(frozen=True, eq=False)
class Stribeck(DryFriction):
    """-(c + b exp(-(v / v_s)^2)) s: dry friction that falls from c + b near rest to c in motion.

    `level` c, `breakaway` b in Nm or N, `stribeck_velocity` v_s in rad/s or m/s (Olsson et al. 1998, eq. 4).
    """

    breakaway: Number = None
    stribeck_velocity: Number = None
    velocity_scale: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = of_friction("breakaway", "stribeck_velocity")


@dataclass(frozen=True, eq=False)
class LoadFriction(DryFriction):
    """-(c + mu |u|) s: dry friction of a gear, which grows with the torque of the actuator.

    `level` c in Nm or N, `factor` mu without unit (Hamon, Gautier & Garrec, IROS 2010, with the output torque).
    """

    factor: Number = None
    velocity_scale: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = of_friction("factor")
    under_load: ClassVar[bool] = True


@dataclass(frozen=True, eq=False)
class GearFriction(LoadFriction):
    """-(c + mu |u| + r sqrt|v| + b exp(-(v / v_s)^2)) s: dry friction of a gear under load, with its lubricant.

    `root` r in Nm (s/rad)^.5 or N (s/m)^.5, of either sign; `breakaway` b, `stribeck_velocity` v_s as in `Stribeck`.
    With `memory` of None a fit gives each joint what held-out stretches of the log show: memory, load, speed,
    breakaway, and of `DirectionalFriction` beside it.
    """

    root: Number = None
    breakaway: Number = None
    stribeck_velocity: Number = None
    memory: Memory | None = field(default=None, kw_only=True)  # type: ignore[assignment]  # open until a fit decides
    coefficients: ClassVar[Mapping[str, Coefficient]] = of_friction("factor", "root", "breakaway", "stribeck_velocity")


@dataclass(frozen=True, eq=False)
class Offset(JointLaw):
    """A constant of either sign in Nm or N: the offset of a torque sensor, or friction that differs by direction."""

    value: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {"value": Coefficient(lowest=-np.inf)}

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return parameters["value"] + torch.zeros_like(features[0])


@dataclass(frozen=True, eq=False)
class Spring(JointLaw):
    """-k (q - q0): a spring of `stiffness` k (Nm/rad or N/m) between links, at rest at the position `rest` q0."""

    in_gear: ClassVar[bool] = False
    stiffness: Number = None
    rest: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {
        "stiffness": Coefficient("force/position"),
        "rest": Coefficient("position", factor=1.0, lowest=-np.inf),
    }

    @override
    def features(self, state: State) -> tuple[Tensor, ...]:
        return (state.positions,)

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return -parameters["stiffness"] * (features[0] - parameters["rest"])


@dataclass(frozen=True, eq=False)
class Rotor(JointLaw):
    """Rotor inertia seen at the joint (kg m^2 or kg), added to the mass matrix on top of the robot's own `armature`.

    With a `transmission` T it adds T^T diag(I) T: its rows say how fast each rotor turns about its axis, in a frame
    that does not, per joint velocity, so that a motor on a moving link also turns with that link. Gyroscopic forces are
    left out. Source: Murphy, Wen & Saridis, ICRA 1990.
    """

    inertia: Number = None
    coefficients: ClassVar[Mapping[str, Coefficient]] = {"inertia": Coefficient("inertia")}

    @override
    def amplitude(self, features: tuple[Tensor, ...], parameters: Mapping[str, Tensor]) -> Tensor:
        return torch.zeros_like(features[0])

    @override
    def inertia_basis(self, robot: Robot) -> Tensor:
        T = self.turning(torch.eye(robot.nv, dtype=torch.float64, device=robot.device)).mT
        return T[:, :, None] * T[:, None, :]


Rows = Float[np.ndarray, "rows nv"]
Inputs = Float[np.ndarray, "rows nu"]


def law_columns(laws: Iterable[Law], robot: Robot, q: np.ndarray, v: Rows, u: Inputs, a: Rows) -> list[Rows]:
    """The torque [Nm or N] that each law of joints needs at these states, of numbers that it is given.

    Laws without numbers count as 1: of a law that is linear in its first coefficient the column is the regressor. Dry
    friction counts as where a joint has slid on for long: these states have no past.
    """
    at_q, at_v, at_u = (torch.tensor(np.array(x), device=robot.device) for x in (q, v, u))
    state, out = State(at_q, at_v, at_u, robot), []
    for law in laws:
        if not isinstance(law, JointLaw):
            continue
        first = next(iter(law.coefficients))
        known = law.with_values({first: 1.0}) if first in law.learned else law  # type: ignore[dict-item]  # a number is one of what coefficients take
        own = (replace(known, memory=False) if isinstance(known, DryFriction) else known).bound_to(robot)
        with torch.no_grad():
            needed, inertia = -own.force(state).cpu().numpy(), own.added_inertia(robot)
        out.append(needed if inertia is None else needed + a @ inertia.cpu().numpy().T)
    return out


def usual_columns(robot: Robot, q: np.ndarray, v: Rows, u: Inputs, a: Rows, widths: Iterable[float]) -> list[Rows]:
    """Of a rotor, viscous friction, dry friction of several widths, and an offset.

    Widths are relative to the root mean square velocity; several of them together are nearly any curve of friction.
    """
    speed = np.square(v).mean(axis=0) ** 0.5 + 1e-12
    dry = (Coulomb(1.0, torch.tensor(width * speed)) for width in widths)
    return law_columns([Rotor(), Viscous(), *dry, Offset(-1.0)], robot, q, v, u, a)
