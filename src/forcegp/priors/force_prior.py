"""What every prior on the unknown force says: Q_U(x) = B(x) f(z(x)) with independent scalar Gaussian processes f_c."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor

from forcegp.mechanics import ConstrainedDynamics
from forcegp.robots import Robot


class ForcePrior(ABC):
    """A prior on the joint force that nobody modelled.

    A new prior is one subclass with the four methods below, and an entry in `forcegp.priors.PRIORS` so that models with
    it can be stored. All methods are pure: the same states give the same answer.
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
