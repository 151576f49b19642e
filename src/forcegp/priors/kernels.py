"""Kernels by name, and as text: names of a registry, "+", "*" and parentheses with the usual precedence.

    expression = term { "+" term }        term = factor { "*" factor }        factor = name | "(" expression ")"

Sums of independent functions have the sum of their kernels, and a product of kernels is a kernel (Rasmussen & Williams
2006, section 4.2.4).

Terms of a sum have log-normal priors on their variances: beside a linear kernel a slow squared exponential ran off to
1e27 times the noise. A kernel by itself has none, for nothing competes with it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial

from gpytorch.kernels import AdditiveKernel, Kernel, ProductKernel, ScaleKernel
from torch import Tensor

from forcegp.errors import InvalidInput, unknown_name_message
from forcegp.priors.basic_kernels import (
    LOG_VARIANCE_SPREAD,
    SmoothSignKernel,
    constant,
    float64,
    friction,
    linear,
    matern,
    periodic,
    rational_quadratic,
    register_log_normal_prior,
    squared_exponential,
    squared_exponential_kernel,
)
from forcegp.priors.deep_kernel import deep

KernelFactory = Callable[[int, Tensor | float], Kernel]
"""Called with the number of features and the start variance of the function; returns a fresh float64 kernel."""

ELSEWHERE = {
    **dict.fromkeys(("rbf", "se", "gaussian", "exponentiated-quadratic"), "squared-exponential"),
    **dict.fromkeys(("matern", "matern52", "matern-52"), "matern-5/2"),
    **dict.fromkeys(("matern32", "matern-32"), "matern-3/2"),
    **dict.fromkeys(("matern12", "exponential", "ornstein-uhlenbeck"), "matern-1/2"),
    **dict.fromkeys(("rq", "rational"), "rational-quadratic"),
    **dict.fromkeys(("dot-product", "linear-kernel"), "linear"),
    "bias": "constant",
}
"""What GPyTorch, scikit-learn and GPy call the kernels of the registry."""

_TOKEN = re.compile(r"[()+*]|[^()+*\s]+")


class KernelExpression:
    """One expression, read once; `kernel` makes fresh kernels of it.

    Raises InvalidInput for an unknown name or a wrong expression, with what is allowed.
    """

    def __init__(self, expression: str, factories: Mapping[str, KernelFactory]) -> None:
        self.expression = expression
        self.factories = factories
        self._tokens = _TOKEN.findall(expression)
        self._build = self._sum()
        if self._tokens:
            raise self._wrong(f"{self._tokens[0]!r} is not expected there")

    def kernel(self, dimension: int, variance: Tensor | float) -> Kernel:
        """A fresh kernel for `dimension` features whose function starts with `variance` at standardised features."""
        return self._build(dimension, variance)

    def _sum(self) -> KernelFactory:
        terms = [self._product()]
        while self._accept("+"):
            terms.append(self._product())
        return terms[0] if len(terms) == 1 else lambda d, variance: _sum_of(terms, d, variance)

    def _product(self) -> KernelFactory:
        factors = [self._factor()]
        while self._accept("*"):
            factors.append(self._factor())
        return factors[0] if len(factors) == 1 else lambda d, variance: _product_of(factors, d, variance)

    def _factor(self) -> KernelFactory:
        if self._accept("("):
            inner = self._sum()
            if not self._accept(")"):
                raise self._wrong("a parenthesis is not closed")
            return inner
        if not self._tokens:
            raise self._wrong("it ends where a name is expected")
        name = self._tokens.pop(0)
        if name in "()+*":
            raise self._wrong(f"{name!r} stands where a name is expected")
        if name not in self.factories:
            where = "the registry" if name == self.expression.strip() else repr(self.expression)
            raise InvalidInput(unknown_name_message("kernel", name, where, self.factories, synonyms=ELSEWHERE))
        return self.factories[name]

    def _accept(self, token: str) -> bool:
        if self._tokens[:1] == [token]:
            self._tokens.pop(0)
            return True
        return False

    def _wrong(self, what: str) -> InvalidInput:
        return InvalidInput(
            f"the kernel {self.expression!r} cannot be read: {what}; write names joined by '+' and '*', with "
            f"parentheses where needed. Names: {', '.join(sorted(self.factories))}"
        )


def _sum_of(terms: list[KernelFactory], dimension: int, variance: Tensor | float) -> Kernel:
    """Every term starts with an equal part of the variance, so that the whole starts with all of it.

    Output scales get the prior that weights have, too: what one term can do another can nearly do, and a slow squared
    exponential beside a linear kernel would run off to 1e27 times the noise (measured on 50 points of `kuka-surface`).
    """
    share = float64(variance) / len(terms)
    kernels = []
    for term in terms:
        kernel = term(dimension, share)
        if type(kernel) is ScaleKernel and "outputscale_prior" not in [name for name, *_ in kernel.named_priors()]:
            register_log_normal_prior(kernel, "outputscale", share, LOG_VARIANCE_SPREAD)
        kernels.extend(kernel.kernels if type(kernel) is AdditiveKernel else [kernel])
    return AdditiveKernel(*kernels)


def _product_of(factors: list[KernelFactory], dimension: int, variance: Tensor | float) -> Kernel:
    """One factor carries the variance; the output scales of the others are taken away, for only their product counts.

    It is the first factor that is more than a scaled kernel (a linear one, a sum), or else the first.
    """
    plain = [factor(dimension, 1.0) for factor in factors]
    carrier = next((i for i, kernel in enumerate(plain) if type(kernel) is not ScaleKernel), 0)
    kernels = []
    for i, kernel in enumerate(plain):
        if i == carrier:
            kernel = factors[i](dimension, variance)
        elif type(kernel) is ScaleKernel:
            kernel = kernel.base_kernel
        kernels.extend(kernel.kernels if type(kernel) is ProductKernel else [kernel])
    return ProductKernel(*kernels)


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
