"""Numbers of a model that may be estimated: `Parameter`, what a law declares of coefficients, and priors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from forcegp.errors import InvalidInput, usable_arguments

UNITS = {
    "force": ("Nm", "N"),
    "position": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
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
    parts: what of it is estimated, out of "mass", "center_of_mass" and "inertia" (about the centre of mass).
    """

    strength: float = 1.0
    parts: tuple[str, ...] = ("mass", "center_of_mass", "inertia")

    @usable_arguments("Body")
    def __post_init__(self) -> None:
        allowed = Body.__dataclass_fields__["parts"].default
        if not self.parts or not set(self.parts) <= set(allowed) or len(set(self.parts)) < len(self.parts):
            raise InvalidInput(f"Body parts are {self.parts!r}; give one or more of {', '.join(allowed)}, each once.")
        if not (isinstance(self.strength, int | float) and 0.0 < self.strength < np.inf):
            raise InvalidInput(
                f"Body strength is {self.strength!r}; it must be > 0, since data never determine all of a body."
            )
        object.__setattr__(self, "parts", tuple(part for part in allowed if part in self.parts))


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
