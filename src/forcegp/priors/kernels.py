"""Kernels by name, with start values.

Any GPyTorch kernel may be used by a prior; these are the ones that the built-in priors share and that settings can
name.
"""

from __future__ import annotations

from functools import partial

from gpytorch.kernels import Kernel
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.priors.deep_kernel import deep
from forcegp.priors.friction_kernel import SmoothSignKernel, friction
from forcegp.priors.kernel_expressions import KernelExpression, KernelFactory
from forcegp.priors.stationary_kernels import (
    matern,
    periodic,
    rational_quadratic,
    squared_exponential,
    squared_exponential_kernel,
)
from forcegp.priors.weight_kernels import constant, linear

__all__ = ["KERNELS", "KernelFactory", "SmoothSignKernel", "check_kernel", "kernel_of", "squared_exponential_kernel"]

KERNELS: dict[str, KernelFactory] = {
    "squared-exponential": squared_exponential,
    "matern-1/2": partial(matern, smoothness=0.5),
    "matern-3/2": partial(matern, smoothness=1.5),
    "matern-5/2": partial(matern, smoothness=2.5),
    "rational-quadratic": rational_quadratic,
    "periodic": periodic,
    "constant": constant,
    "linear": linear,
    "friction": friction,
    "deep": deep,
}
"""Kernels that an expression can name: name -> factory(dimension, variance). Add your own, `KERNELS["mine"] = factory`;
a name may hold anything but white space, parentheses, "+" and "*".
"""


def kernel_of(expression: str, dimension: int, variance: Tensor | float) -> Kernel:
    """A fresh float64 kernel on `dimension` prepared features, for a function that starts with `variance`.

    `expression` is a name in `KERNELS`, or several joined by "+" and "*", as in "linear + squared-exponential" or
    "periodic * (constant + linear)". The terms of a sum start with equal parts of the variance. In a product one factor
    carries it, and output scales of the others, of which only the product counts, are taken away.

    Raises
    ------
    InvalidInput: an unknown name, an expression that cannot be read, or a kernel that cannot have so many features.
    """
    return KernelExpression(expression, KERNELS).kernel(dimension, variance)


def check_kernel(expression: object) -> None:
    """Raise InvalidInput if `expression` is no text, cannot be read or has an unknown name; for constructors."""
    if not isinstance(expression, str):
        raise InvalidInput(f"the kernel is {expression!r}; give an expression such as 'linear + squared-exponential'.")
    KernelExpression(expression, KERNELS)
