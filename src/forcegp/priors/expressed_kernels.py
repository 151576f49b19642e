"""What priors share whose kernels are written as one expression for all their latents."""

from __future__ import annotations

from typing import Any

from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.priors.force_prior import ForcePrior
from forcegp.priors.kernels import kernel_of
from forcegp.robots import Robot


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
