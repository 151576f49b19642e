"""Surfaces s(p) = 0 that a point of the robot can be held on, with derivatives; p (..., 3) in m, world axes.

The built-in ones are signed distances: a multiplier is the normal force in N. One of your own is a class with `value`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import ContactError, FileFormatError, InvalidInput
from forcegp.robots.arguments import finite_vector

Vector = tuple[float, float, float]


class Surface(ABC):
    """A level set s(p) = 0; `value` must be twice differentiable and written with torch operations."""

    @abstractmethod
    def value(self, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """s(p) at points p (..., 3) in m; 0 on the surface, positive on the side that the gradient points to."""

    def gradient(self, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """s_p = ds/dp (..., 3)."""
        return self._over_batch(torch.func.grad(self.value), p, (3,))

    def hessian(self, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
        """s_pp = d2s/dp2 (..., 3, 3)."""
        return self._over_batch(torch.func.jacrev(torch.func.grad(self.value)), p, (3, 3))

    @staticmethod
    def _over_batch(function: Callable[[Tensor], Tensor], p: Tensor, trailing: tuple[int, ...]) -> Tensor:
        flat = p.reshape(-1, 3)
        if not flat.shape[0]:
            return p.new_zeros(*p.shape[:-1], *trailing)
        return torch.func.vmap(function)(flat).reshape(*p.shape[:-1], *trailing)


class _Flat(Surface):  # the same unit normal everywhere
    normal: Vector

    @override
    def gradient(self, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        return _tensor(self.normal, p).expand(p.shape)

    @override
    def hessian(self, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
        return p.new_zeros(*p.shape[:-1], 3, 3)


@dataclass(frozen=True)
class Plane(_Flat):
    """The plane n . p = offset; `normal` need not be a unit vector (then n and offset are divided by its length)."""

    normal: Vector
    offset: float

    def __post_init__(self) -> None:
        normal, length = direction("Plane normal", self.normal)
        object.__setattr__(self, "normal", normal)
        object.__setattr__(self, "offset", _number("Plane offset", self.offset) / length)

    @override
    def value(self, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return p @ _tensor(self.normal, p) - self.offset


@dataclass(frozen=True)
class Held(_Flat):
    """A direction `normal` along which a point does not move, wherever it stands: its value is 0 everywhere."""

    normal: Vector

    def __post_init__(self) -> None:
        object.__setattr__(self, "normal", direction("Held normal", self.normal)[0])

    @override
    def value(self, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return torch.zeros_like(p[..., 0])


@dataclass(frozen=True)
class Sphere(Surface):
    """The sphere |p - center| = radius; the normal points outwards."""

    center: Vector
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", _vector("Sphere center", self.center))
        object.__setattr__(self, "radius", _number("Sphere radius", self.radius))
        if self.radius <= 0.0:
            raise InvalidInput(f"Sphere radius is {self.radius}; it must be positive (m).")

    @override
    def value(self, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return torch.linalg.vector_norm(p - _tensor(self.center, p), dim=-1) - self.radius

    @override
    def gradient(self, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        ray = p - _tensor(self.center, p)
        return ray / torch.linalg.vector_norm(ray, dim=-1, keepdim=True)

    @override
    def hessian(self, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
        normal = self.gradient(p)[..., None]  # (1 - n n^T) / |ray|
        distance = torch.linalg.vector_norm(p - _tensor(self.center, p), dim=-1)[..., None, None]
        return (torch.eye(3, dtype=p.dtype, device=p.device) - normal @ normal.mT) / distance


@dataclass(frozen=True)
class ImplicitSurface(Surface):
    """s(p) = function(p) for any twice differentiable `function` of one point (3,) -> scalar, written in torch.

    The multiplier of a contact is the normal force divided by |s_p|. Files never carry code, so it cannot be stored.
    """

    function: Callable[[Tensor], Tensor] = field(compare=True)

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise InvalidInput(f"ImplicitSurface function is {self.function!r}; give a function of one point (3,).")

    @override
    def value(self, p: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self._over_batch(self._at_one_point, p, ()) if p.dim() > 1 else self._at_one_point(p)

    def _at_one_point(self, p: Tensor) -> Tensor:
        value = self.function(p)
        if not isinstance(value, Tensor) or value.dim():
            given = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            raise ContactError(f"ImplicitSurface function returned {given} for one point (3,); return a scalar tensor.")
        return value


SURFACES: dict[str, type[Surface]] = {"plane": Plane, "sphere": Sphere, "held": Held}
"""Surfaces that files can carry, by the name they have there."""


def surface_to_dict(surface: Surface) -> dict[str, Any]:
    """Plain numbers for `surface_from_dict`. Raises ContactError for a surface that holds code."""
    name = next((name for name, kind in SURFACES.items() if type(surface) is kind), None)
    if name is None:
        seen = f"a {type(surface).__name__} cannot be stored: files carry numbers, never code"
        own = "a Surface of your own with numbers as fields and an entry in SURFACES"
        raise ContactError(f"{seen}. Use one of {', '.join(SURFACES)}, or {own}.")
    return {"type": name, **asdict(surface)}  # type: ignore[call-overload]  # every entry of SURFACES is a dataclass


def surface_from_dict(stored: object) -> Surface:
    """The surface that `surface_to_dict` stored; FileFormatError for anything else."""
    return from_stored("surface", stored, SURFACES, SURFACES.__getitem__, "known")


def from_stored(what: str, stored: object, known: Collection[str], kind: Callable[[str], Any], remedy: str) -> Any:
    """The `kind` of a stored type that is `known`, with its stored fields; lists become tuples. FileFormatError."""
    if not isinstance(stored, Mapping):
        raise FileFormatError(f"a stored {what} is {stored!r}; expected an object with a type")
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in stored.items()}
    name = values.pop("type", None)
    if not isinstance(name, str) or name not in known:
        raise FileFormatError(f"unknown {what} {name!r}; {remedy}: {', '.join(known)}")
    try:
        return kind(name)(**values)
    except TypeError as error:
        raise FileFormatError(f"{what} {name!r} has wrong fields {sorted(map(str, values))}: {error}") from None


def _tensor(values: Sequence[float], like: Tensor) -> Tensor:
    return torch.tensor(values, dtype=like.dtype, device=like.device)


def _number(name: str, value: object) -> float:
    try:
        number = math.nan if isinstance(value, str) else float(value)  # type: ignore[arg-type]  # what is no number is an error below
    except (TypeError, ValueError, RuntimeError):
        raise InvalidInput(f"{name} is {value!r}; give a number.") from None
    if not math.isfinite(number):
        raise InvalidInput(f"{name} is {value!r}; give a finite number.")
    return number


def _vector(name: str, values: object) -> Vector:
    return tuple(finite_vector(name, values, 3, " x, y, z").tolist())  # type: ignore[return-value]  # three of them


def direction(name: str, values: object) -> tuple[Vector, float]:
    """The unit vector along three numbers, unchanged where it is one up to rounding, and their length."""
    entries = _vector(name, values)
    length = math.hypot(*entries)
    if not 0.0 < length < math.inf:
        raise InvalidInput(f"{name} is {values!r}; give a direction, for example (0, 0, 1).")
    if abs(length - 1.0) < 1e-15:
        return entries, 1.0
    return tuple(entry / length for entry in entries), length  # type: ignore[return-value]  # three of them, as the others


TURNED_OVER = -0.9
"""z component of a normal below which the axes are turned from -z instead of z, where turning from z is ill-defined."""


def surface_axes(gradients: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Columns t1, t2, n of the rotation that turns the world's z axis the shortest way onto the normal n.

    `gradients` have any positive length. On a table the tangents are x and y; they are smooth but where n points nearly
    straight down (from -z there, and t2 is -y): I + [w] + [w]^2 / (1 + c) with w = z x n, c = n_z (Rodrigues' formula).
    """
    n = gradients / torch.linalg.vector_norm(gradients, dim=-1, keepdim=True)
    flip = torch.where(n[..., 2] < TURNED_OVER, -1.0, 1.0)
    x, y, z = n[..., 0], n[..., 1], n[..., 2] * flip  # turned over: mirrored at z = 0, then t2 is mirrored back
    shrink = 1.0 / (1.0 + z)
    t1 = torch.stack([1.0 - x * x * shrink, -x * y * shrink, -x * flip], dim=-1)
    t2 = torch.stack([-x * y * shrink, 1.0 - y * y * shrink, -y * flip], dim=-1) * flip[..., None]
    return torch.stack([t1, t2, n], dim=-1)
