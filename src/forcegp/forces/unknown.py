"""What every prior on the unknown force defines: Q_U(x) = B(x) f(z(x)) with independent Gaussian processes f_c."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any, ClassVar, Literal

import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.forces.force import Force
from forcegp.forces.kernels import checked_kernel, kernel_of
from forcegp.mechanics import ConstrainedDynamics, Contact
from forcegp.robots import Robot
from forcegp.robots.arguments import is_sequence

Scaling = Literal["standardize", "scale", "none"]
"""How a model prepares the features of a latent for its kernel, from the training points: shift to mean 0 and divide by
the standard deviation; only divide by the root mean square, where zero means something (a velocity); or leave alone.
"""


class Unknown(Force):
    """A force that nobody modelled: its amplitudes are functions with Gaussian process priors, f_c ~ GP(0, k_c).

    A subclass has the four abstract methods, and an entry in `forcegp.forces.FORCES`, so that files and commands name
    it. All methods are pure: the same states give the same answer.
    """

    @abstractmethod
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        """One readable name per latent function."""

    @abstractmethod
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        """B(x) (..., nv, C): the joint force (Nm or N) that one unit of each latent makes."""

    @abstractmethod
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        """z_c(x) (..., d_c), one tensor per latent, in physical units; the model standardises them."""

    @abstractmethod
    def kernels(self, robot: Robot, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        """Fresh kernels with start values, for prepared features of these numbers and latents of these variances."""

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
        """Force [N, world axes] that one unit of each latent exerts on a point; None for priors of joint forces."""
        return None


@dataclass(frozen=True)
class UnknownForces(Unknown):
    """Q_U = sum of what the `terms` describe, independent of each other; none of them: Q_U = 0.

    Columns of B, features and kernels stand side by side, so that one fit learns them all and `posterior.components`
    finds every term by its slice of the latents. Raises InvalidInput for two equal terms, which no data could separate.
    """

    terms: tuple[Unknown, ...] = ()

    def __post_init__(self) -> None:
        for index, term in enumerate(self.terms):
            if term in self.terms[:index]:
                raise InvalidInput(f"forces hold {term.title!r} twice, which no data can separate; give it once.")

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
            name if len(self.terms) == 1 else f"{title} {name}"
            for title, term in zip(self.term_names, self.terms, strict=True)
            for name in term.latent_names(robot)
        )

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        if len(self.terms) == 1:
            return self.terms[0].direction(dynamics)
        return torch.cat([dynamics.H[..., :0], *(term.direction(dynamics) for term in self.terms)], dim=-1)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        return self._joined(lambda term: term.features(dynamics))

    @override
    def kernels(self, robot: Robot, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        found = list[Kernel]()
        for term, part in zip(self.terms, self.slices(robot), strict=True):
            kernels, own = term.kernels(robot, dimensions[part], variances[part]), type(term).__name__
            # one kernel alone would be iterated over without an end
            if not isinstance(kernels, list | tuple) or not all(isinstance(kernel, Kernel) for kernel in kernels):
                raise InvalidInput(f"{own}.kernels must give a tuple of GPyTorch kernels, one per latent")
            if len(kernels) != len(dimensions[part]):
                raise InvalidInput(f"{own}.kernels gives {len(kernels)} kernels for {len(dimensions[part])} latents")
            found += kernels
        return tuple(found)

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
    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        for term in self.terms:
            term.check(robot, contacts)

    def named(self, robot: Robot) -> list[tuple[str, Unknown, slice]]:
        """Name, term and latents of every one that adds up."""
        return list(zip(self.term_names, self.terms, self.slices(robot), strict=True))

    def slices(self, robot: Robot) -> tuple[slice, ...]:
        """Which of the latents belong to each term."""
        ends = accumulate((len(term.latent_names(robot)) for term in self.terms), initial=0)
        return tuple(slice(start, stop) for start, stop in pairwise(ends))

    def _joined(self, of: Callable[[Unknown], tuple[Any, ...]]) -> tuple[Any, ...]:
        return tuple(entry for term in self.terms for entry in of(term))


class ExpressedKernels(Unknown):
    """A dataclass of plain values, every latent of which has a kernel of the same expression, the field `kernel`."""

    kernel: str

    @override
    def kernels(self, robot: Robot, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        return tuple(kernel_of(self.kernel, d, s) for d, s in zip(dimensions, variances, strict=True))


class SharedInputs(ExpressedKernels):
    """All latents depend on the same `inputs`, chosen by name; a subclass is a dataclass that has them as a field."""

    inputs: tuple[str, ...]
    allowed: ClassVar[tuple[str, ...]]
    from_zero: ClassVar[tuple[str, ...]] = ()
    """Inputs of which zero means something: scaled, never shifted."""

    def __post_init__(self) -> None:
        inputs, prior = as_names(self.inputs), type(self).__name__
        if not inputs or any(name not in self.allowed for name in inputs) or len(set(inputs)) < len(inputs):
            names = ", ".join(map(repr, self.allowed))
            raise InvalidInput(f"{prior} inputs are {self.inputs!r}; give one or more of {names}, each once.")
        object.__setattr__(self, "inputs", inputs)
        checked_kernel(self.kernel)

    @abstractmethod
    def columns(self, dynamics: ConstrainedDynamics) -> Mapping[str, Callable[[], Tensor]]:
        """What gives the features of each input."""

    @abstractmethod
    def labels(self, robot: Robot) -> Mapping[str, Sequence[str]]:
        """Names with units of the features of each input."""

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        columns = self.columns(dynamics)
        z = torch.cat([columns[name]() for name in self.inputs], dim=-1)
        return (z,) * len(self.latent_names(dynamics.state.robot))

    @override
    def scalings(self, robot: Robot) -> tuple[tuple[Scaling, ...], ...]:
        labels, how = self.labels(robot), {True: "scale", False: "standardize"}
        ways: Any = tuple(how[name in self.from_zero] for name in self.inputs for _ in labels[name])
        return (ways,) * len(self.latent_names(robot))

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        labels = self.labels(robot)
        return (tuple(label for name in self.inputs for label in labels[name]),) * len(self.latent_names(robot))


def as_names(given: object) -> tuple[Any, ...]:
    """One name, or several, as a tuple; empty for what is neither."""
    return (given,) if isinstance(given, str) else tuple(given) if is_sequence(given) else ()


def has_few_inputs(prior: Unknown, robot: Robot) -> bool:
    """Whether every function of the prior has one or two inputs: then some dozens of points stand for all rows."""
    names = prior.feature_names(robot)
    return bool(names) and all(0 < len(inputs) <= 2 for inputs in names)
