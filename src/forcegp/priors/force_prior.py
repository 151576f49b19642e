"""What every prior on the unknown force says: Q_U(x) = B(x) f(z(x)) with independent scalar Gaussian processes f_c."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Literal

from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor

from forcegp.mechanics import ConstrainedDynamics
from forcegp.robots import Robot

if TYPE_CHECKING:
    from forcegp.priors.sum_prior import SumPrior

Scaling = Literal["standardize", "scale", "none"]
"""How a model prepares the features of a latent for its kernel, from the training points: shift to mean 0 and divide by
the standard deviation; only divide by the root mean square, where zero means something (a velocity); or leave alone.
"""


class ForcePrior(ABC):
    """A prior on the joint force that nobody modelled.

    A new prior is one subclass with the five abstract methods, and an entry in `forcegp.priors.PRIORS` so that models
    with it can be stored. All methods are pure: the same states give the same answer. Priors add up: `a + b` says that
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
    def kernels(self, dimensions: tuple[int, ...], variances: Float[Tensor, " C"]) -> tuple[Kernel, ...]:
        """Fresh kernels with start values, for standardised features and latents of these variances."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """The fields as plain JSON values."""

    def scalings(self, robot: Robot) -> tuple[Scaling, ...]:
        """How the features of each latent are prepared for its kernel."""
        return ("standardize",) * len(self.latent_names(robot))

    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...] | None:
        """A readable name for every feature of every latent, for messages and plots; None where it has none."""
        return None

    def point_force(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch 3 C"] | None:
        """Force in N along the axes of the world that one unit of each latent exerts on a point of the robot.

        None for priors that speak of joint forces only.
        """
        return None

    @property
    def terms(self) -> tuple[ForcePrior, ...]:
        """The priors that add up to this one."""
        return (self,)

    def __add__(self, other: ForcePrior) -> SumPrior:
        """Q_U is the sum of what both describe."""
        from forcegp.priors.sum_prior import SumPrior

        return SumPrior((*self.terms, *other.terms))
