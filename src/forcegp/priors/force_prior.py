"""What every prior on the unknown force defines: Q_U(x) = B(x) f(z(x)) with independent Gaussian processes f_c."""

import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import accumulate, pairwise
from typing import Any, Literal

import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.mechanics import ConstrainedDynamics, MechanicalSystem
from forcegp.priors.kernels import kernel_of
from forcegp.robots import Robot
from forcegp.robots.arguments import is_sequence

Scaling = Literal["standardize", "scale", "none"]
"""How a model prepares the features of a latent for its kernel, from the training points: shift to mean 0 and divide by
the standard deviation; only divide by the root mean square, where zero means something (a velocity); or leave alone.
"""


class ForcePrior(ABC):
    """A prior on the joint force that nobody modelled.

    A new prior is one subclass with the four abstract methods, and an entry in `forcegp.priors.PRIORS` so that models
    with it can be stored. All methods are pure: the same states give the same answer. Priors add up: `a + b` means that
    the unknown force is the sum of what the two describe.
    """

    @abstractmethod
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        """One readable name per latent function."""

    @abstractmethod
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        """B(x) (..., nv, C): the joint force (Nm or N) that one unit of each latent makes."""

    @abstractmethod
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        """z_c(x) (..., d_c), one tensor per latent, in physical units; the model standardises them."""

    @abstractmethod
    def kernels(self, robot: Robot, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        """Fresh kernels with start values, for prepared features of these numbers and latents of these variances."""

    def to_dict(self) -> dict[str, Any]:
        """The fields of a dataclass as plain JSON values."""
        return asdict(self)  # type: ignore[call-overload]  # priors are dataclasses, or have their own

    def scalings(self, robot: Robot) -> tuple[tuple[Scaling, ...] | Scaling, ...]:
        """How the features of each latent are prepared for its kernel: one way for all of them, or one for each."""
        return ("standardize",) * len(self.latent_names(robot))

    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...] | None:
        """A readable name with its unit for every feature of every latent, for messages and plots; None without."""
        return None

    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        """The unit of each latent."""
        return ("Nm or N",) * len(self.latent_names(robot))

    def point_force(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch 3 C"] | None:
        """Force in N along the axes of the world that one unit of each latent exerts on a point of the robot.

        None for priors of joint forces only.
        """
        return None

    def check(self, system: MechanicalSystem) -> None:
        """Raise InvalidInput where this prior means nothing for this system: a frame or contact that is not there."""
        return

    @property
    def title(self) -> str:
        """What the prior is called where its forces are listed, for example "joint-friction"."""
        return re.sub(r"(?<!^)(?=[A-Z])", "-", type(self).__name__).lower()

    def summands(self) -> "tuple[ForcePrior, ...]":
        """The priors that add up to this one."""
        return (self,)

    def __add__(self, other: "ForcePrior") -> "SumPrior":
        """Q_U is the sum of what both describe. Raises InvalidInput for what is no prior, as `SumPrior`."""
        if not isinstance(other, ForcePrior):
            return SumPrior((self, other))
        return SumPrior((*self.summands(), *other.summands()))

    def __radd__(self, other: object) -> "ForcePrior":
        """`sum([a, b])` begins with 0. Raises InvalidInput for anything else that is no prior, as `SumPrior`."""
        return self if isinstance(other, int) and other == 0 else SumPrior((other, self))  # type: ignore[arg-type]  # refused there


# Here because `ForcePrior.__add__` makes sums.
@dataclass(frozen=True)
class SumPrior(ForcePrior):
    """Q_U = sum of what the `terms` describe, independent of each other: `JointFriction() + ContactFriction()`.

    Columns of B, features and kernels stand side by side, so that one fit learns them all and `posterior.components`
    finds every term by its slice of the latents. Sums among the terms are taken apart. Raises InvalidInput for fewer
    than two terms and for two equal ones, which no data could separate.
    """

    terms: tuple[ForcePrior, ...]

    def __post_init__(self) -> None:
        given: tuple[Any, ...] = tuple(self.terms) if is_sequence(self.terms) else (self.terms,)
        if not all(isinstance(term, ForcePrior) for term in given):
            kinds = ", ".join(type(term).__name__ for term in given)
            raise InvalidInput(
                f"the terms of a SumPrior are {kinds}; give priors, as in JointFriction() + Payload(...)"
            )
        terms = tuple(inner for term in given for inner in term.summands())
        if len(terms) < 2:
            raise InvalidInput(f"a SumPrior has {len(terms)} terms; give two or more, or use the prior itself")
        for index, term in enumerate(terms):
            if term in terms[:index]:
                raise InvalidInput(f"the sum has {term.title!r} twice, which no data can separate; give it once")
        object.__setattr__(self, "terms", terms)

    @override
    def summands(self) -> tuple[ForcePrior, ...]:
        return self.terms

    @property
    def term_names(self) -> tuple[str, ...]:
        """The title of every term, numbered where several have the same."""
        titles = [term.title for term in self.terms]
        return tuple(
            title if titles.count(title) == 1 else f"{title}-{titles[: index + 1].count(title)}"
            for index, title in enumerate(titles)
        )

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return tuple(
            f"{title} {name}"
            for title, term in zip(self.term_names, self.terms, strict=True)
            for name in term.latent_names(robot)
        )

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        return torch.cat([term.mixing(dynamics) for term in self.terms], dim=-1)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        return self._joined(lambda term: term.features(dynamics))

    @override
    def kernels(self, robot: Robot, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        return tuple(
            kernel
            for term, part in zip(self.terms, self.slices(robot), strict=True)
            for kernel in term.kernels(robot, dimensions[part], variances[part])
        )

    @override
    def scalings(self, robot: Robot) -> tuple[tuple[Scaling, ...] | Scaling, ...]:
        return self._joined(lambda term: term.scalings(robot))

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...] | None:
        names = [term.feature_names(robot) for term in self.terms]
        known = [part for part in names if part is not None]
        return tuple(entry for part in known for entry in part) if len(known) == len(names) else None

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return self._joined(lambda term: term.latent_units(robot))

    @override
    def check(self, system: MechanicalSystem) -> None:
        for term in self.terms:
            term.check(system)

    @override
    def to_dict(self) -> dict[str, Any]:
        return {"terms": [{"prior": type(term).__name__, **term.to_dict()} for term in self.terms]}

    def slices(self, robot: Robot) -> tuple[slice, ...]:
        """Which of the latents belong to each term."""
        ends = accumulate((len(term.latent_names(robot)) for term in self.terms), initial=0)
        return tuple(slice(start, stop) for start, stop in pairwise(ends))

    def _joined(self, of: Callable[[ForcePrior], tuple[Any, ...]]) -> tuple[Any, ...]:
        return tuple(entry for term in self.terms for entry in of(term))


class ExpressedKernels(ForcePrior):
    """A dataclass of plain values whose `kernel_expression` every latent has a kernel of."""

    kernel: Any  # an expression, or None, of which every subclass names its own

    @property
    def kernel_expression(self) -> str:
        """An expression of `forcegp.priors.kernel_of`."""
        assert isinstance(self.kernel, str), "a prior whose kernel may be None overrides this"
        return self.kernel

    @override
    def kernels(self, robot: Robot, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        return kernels_of(self.kernel_expression, dimensions, variances)


def kernels_of(expression: str, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
    """One kernel per latent from the same expression."""
    return tuple(
        kernel_of(expression, dimension, variance) for dimension, variance in zip(dimensions, variances, strict=True)
    )


def has_few_inputs(prior: ForcePrior, robot: Robot) -> bool:
    """Whether every function of the prior has one or two inputs: then some dozens of points stand for all rows."""
    names = prior.feature_names(robot)
    return bool(names) and all(0 < len(inputs) <= 2 for inputs in names)
