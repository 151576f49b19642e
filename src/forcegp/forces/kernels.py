"""Kernels by name, and as text: names of a registry, "+", "*" and parentheses with the usual precedence.

    expression = term { "+" term }        term = factor { "*" factor }        factor = name | "(" expression ")"

Sums of independent functions have the sum of their kernels, and a product of kernels is a kernel (Rasmussen & Williams
2006, section 4.2.4).

Terms of a sum have log-normal priors on their variances (`_sum_of`); a kernel by itself has none.
"""

import math
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from gpytorch.kernels import AdditiveKernel, Kernel, ProductKernel, ScaleKernel
from gpytorch.priors import NormalPrior, Prior
from gpytorch.priors.utils import _bufferize_attributes
from torch import Tensor
from torch.distributions import StudentT
from typing_extensions import override

from forcegp.errors import InvalidInput, require_known
from forcegp.forces.basic_kernels import (
    LOG_LENGTHSCALE_SPREAD,
    LOG_VARIANCE_SPREAD,
    SmoothSignKernel,
    constant,
    float64,
    friction,
    linear,
    log_scale,
    matern,
    periodic,
    rational_quadratic,
    register_log_normal_prior,
    squared_exponential,
    squared_exponential_kernel,
    typical_lengthscale,
)

UNITS = 2
"""Places of abrupt change."""

STEEPNESS = 4.0
"""Of the units, per standardised feature: a change takes about half a standard deviation of the features."""

STEEPNESS_LOG_SPREAD = 0.3

CHANGE = 0.5
"""Start value of the change that a unit makes: exp(-1/2 (2 CHANGE)^2) = 0.61 of the correlation across is left."""

SPARSE_SCALE = 0.01
COST_PER_PARAMETER = 0.3
"""The prior on a change a is (1 + a^2 / SPARSE_SCALE^2)^-(COST_PER_PARAMETER parameters of the unit): a change of 0.6
costs 2.5 nats for every parameter, about what the Bayesian information criterion asks for at 100 points.
"""

SEED = 20160509
"""Of the places where the units begin, which are the same for every kernel of a dimension."""


def deep(dimension: int, variance: float | Tensor) -> ScaleKernel:
    """variance times `NetworkKernel`: like the squared exponential, with abrupt changes where the data ask for them.

    Source: Wilson et al., "Deep kernel learning", AISTATS (2016). Ober et al., "The promises and pitfalls of deep
    kernel learning", UAI (2021), show that such kernels overfit: two hidden layers of eight units with normal priors on
    their weights did so here, too (`python -m benchmarks.kernels` has the numbers of what is left). So the network has
    one layer of few, steep units, and each has to earn its parameters against a sparse prior.
    """
    kernel = ScaleKernel(NetworkKernel(dimension), outputscale_constraint=log_scale()).double()
    kernel.outputscale = float64(variance)
    return kernel


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


class NetworkKernel(Kernel):
    """k = exp(-1/2 |e(z) - e(z')|^2) with e(z) = [z / l, h(z)] and units h_k = a_k tanh(4 (w_k . z + b_k)).

    Where a_k = 0 this is the squared exponential with length scales l. Else the plane w_k . z + b_k = 0 divides the
    space of features, and values on its two sides have less in common. Priors: l as for the squared exponential;
    log |w_k| ~ N(0, 0.3^2), since slow units would learn what smooth functions of all features are and be too sure of
    it; b_k ~ N(0, 1); a Student t distribution of small scale for a_k, which makes a unit that is not needed vanish.

    Parameters: raw_lengthscale (1, dimension), slope (2, dimension), bias (2,), change (2,).
    """

    has_lengthscale = True

    def __init__(self, dimension: int) -> None:
        super().__init__(ard_num_dims=dimension, lengthscale_constraint=log_scale())
        self.double()
        self.lengthscale = float64(math.sqrt(dimension)).expand(1, dimension)
        register_log_normal_prior(self, "lengthscale", typical_lengthscale(dimension), LOG_LENGTHSCALE_SPREAD)
        random = torch.randn(UNITS, dimension + 1, generator=torch.Generator().manual_seed(SEED), dtype=torch.float64)
        directions = torch.nn.functional.normalize(random[:, :-1], dim=-1)
        self.slope = torch.nn.Parameter(directions)
        self.bias = torch.nn.Parameter(random[:, -1].clone())
        self.change = torch.nn.Parameter(torch.full((UNITS,), CHANGE, dtype=torch.float64))
        zero, one = float64(0.0), float64(1.0)
        self.register_prior("slope_prior", NormalPrior(zero, STEEPNESS_LOG_SPREAD * one), _log_steepness)
        self.register_prior("bias_prior", NormalPrior(zero, one), partial(_parameter, "bias"))
        degrees = 2.0 * COST_PER_PARAMETER * (dimension + 2) - 1.0
        sparse = StudentTPrior(degrees * one, zero, SPARSE_SCALE / math.sqrt(degrees) * one)
        self.register_prior("change_prior", sparse, partial(_parameter, "change"))

    def units(self, z: Tensor) -> Tensor:
        """h(z) (n, 2)."""
        return self.change * torch.tanh(STEEPNESS * (z @ self.slope.mT + self.bias))

    def squared_exponential_embedding(self, z: Tensor) -> Tensor:
        """e(z) (n, dimension + 2), in which the kernel is the squared exponential of length scale 1."""
        return torch.cat([z / self.lengthscale, self.units(z)], dim=-1)

    @override
    def forward(
        self, x1: Tensor, x2: Tensor, diag: bool = False, last_dim_is_batch: bool = False, **params: Any
    ) -> Tensor:
        left, right = self.squared_exponential_embedding(x1), self.squared_exponential_embedding(x2)
        difference = left - right if diag else left[..., :, None, :] - right[..., None, :, :]
        return torch.exp(-0.5 * difference.square().sum(-1))


class StudentTPrior(Prior, StudentT):  # type: ignore[misc]  # the bases name the argument of log_prob differently
    """A Student t distribution as a GPyTorch prior; df, loc and scale are tensors."""

    def __init__(self, df: Tensor, loc: Tensor, scale: Tensor) -> None:
        torch.nn.Module.__init__(self)
        StudentT.__init__(self, df, loc, scale, validate_args=False)
        _bufferize_attributes(self, ("df", "loc", "scale"))
        self._transform = None


def _parameter(name: str, kernel: NetworkKernel) -> Tensor:
    return getattr(kernel, name)


def _log_steepness(kernel: NetworkKernel) -> Tensor:
    return torch.linalg.vector_norm(kernel.slope, dim=-1).log()


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
    "deep": deep,
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
