"""Kernels by name, and as text: names of a registry, "+", "*" and parentheses with the usual precedence.

    expression = term { "+" term }        term = factor { "*" factor }        factor = name | "(" expression ")"

Sums of independent functions have the sum of their kernels, and a product of kernels is a kernel (Rasmussen & Williams
2006, section 4.2.4).

Terms of a sum have log-normal priors on their variances (`_sum_of`); a kernel by itself has none.
"""

import re
from collections.abc import Callable
from functools import partial

from gpytorch.kernels import AdditiveKernel, Kernel, ProductKernel, ScaleKernel
from torch import Tensor

from forcegp.errors import InvalidInput, require_known
from forcegp.forces.basic_kernels import (
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

DEVIATION = 1e-4


def deviation(dimension: int, variance: float | Tensor) -> ScaleKernel:
    """The squared exponential where it starts, and is expected, with `DEVIATION` of the variance.

    For what a linear law beside it leaves. With an equal part of the variance the squared exponential takes over what
    the law describes, and gives it up beyond the data: positions of a drone in new wind were off by 7-15 % more after
    .5 s (three seeds of `python -m benchmarks.quadrotor`).
    """
    kernel = squared_exponential(dimension, DEVIATION * float64(variance))
    register_log_normal_prior(kernel, "outputscale", DEVIATION * float64(variance), LOG_VARIANCE_SPREAD)
    return kernel


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


def kernel_factory(expression: str) -> KernelFactory:
    """The kernel of an expression. Raises InvalidInput for unknown names or a wrong form, with what is allowed."""
    tokens = _TOKEN.findall(expression)

    def wrong(what: str) -> InvalidInput:
        return InvalidInput(
            f"the kernel {expression!r} cannot be read: {what}; write names joined by '+' and '*', with "
            f"parentheses where needed. Names: {', '.join(sorted(KERNELS))}"
        )

    def joined(separator: str, read: Callable[[], KernelFactory], join: Callable[..., Kernel]) -> KernelFactory:
        parts = [read()]
        while tokens[:1] == [separator]:
            tokens.pop(0)
            parts.append(read())
        return parts[0] if len(parts) == 1 else partial(join, parts)

    def factor() -> KernelFactory:
        if not tokens:
            raise wrong("it ends where a name is expected")
        name = tokens.pop(0)
        if name == "(":
            inner = joined("+", term, _sum_of)
            if tokens[:1] != [")"]:
                raise wrong("a parenthesis is not closed")
            tokens.pop(0)
            return inner
        if name in "()+*":
            raise wrong(f"{name!r} stands where a name is expected")
        where = "the registry" if name == expression.strip() else repr(expression)
        require_known("kernel", name, where, KERNELS, synonyms=ELSEWHERE)
        return KERNELS[name]

    term = partial(joined, "*", factor, _product_of)
    found = joined("+", term, _sum_of)
    if tokens:
        raise wrong(f"{tokens[0]!r} is not expected there")
    return found


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
    "deviation": deviation,
}
"""Kernels that an expression can name: name -> factory(dimension, variance). Add your own, `KERNELS["mine"] = factory`;
a name may hold anything but white space, parentheses, "+" and "*"."""


def kernel_of(expression: str, dimension: int, variance: Tensor | float) -> Kernel:
    """A fresh float64 kernel on `dimension` prepared features, for a function that starts with `variance`.

    `expression` is a name in `KERNELS`, or several joined by "+" and "*", as in "linear + squared-exponential" or
    "periodic * (constant + linear)". The terms of a sum start with equal parts of the variance. In a product one factor
    carries it, and output scales of the others, of which only the product counts, are taken away.

    Raises
    ------
    InvalidInput: an unknown name, an expression that cannot be read, or a kernel that cannot have so many features.
    """
    return kernel_factory(expression)(dimension, variance)


def check_kernel(expression: object) -> None:
    """Raise InvalidInput if `expression` is no text, cannot be read or has an unknown name; for constructors."""
    if not isinstance(expression, str):
        raise InvalidInput(f"the kernel is {expression!r}; give an expression such as 'linear + squared-exponential'.")
    kernel_factory(expression)
