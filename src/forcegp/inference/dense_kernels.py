"""Kernels of all latents: matrices of GPyTorch kernels, exact and lean, and their parameters by name.

GPyTorch's own sums need jitter, and switch silently to conjugate gradients above N D = 800. A kernel class of anybody
may have `squared_exponential_embedding(z)` (n, e), for k = exp(-1/2 |e - e'|^2); `matern_embedding(z)` and `nu`; or
`weight_features(z)` (n, p), for k = phi . phi', all differentiable. Every other kernel is called as it is.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import partial, reduce
from operator import add, mul
from typing import Any, cast

import torch
from gpytorch.kernels import (
    AdditiveKernel,
    ConstantKernel,
    Kernel,
    LinearKernel,
    MaternKernel,
    PeriodicKernel,
    ProductKernel,
    RBFKernel,
    ScaleKernel,
)
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call
from typing_extensions import override

from forcegp.errors import InvalidInput

PointMap = Callable[[Tensor], Tensor]
"""Features (n, d) -> something (n, _) of every point."""

NO_DISTANCE = 1e-8
"""Scaled distance below which the derivative of a kernel with a kink at zero counts as zero."""


def embedding(kernel: Kernel) -> tuple[PointMap, float] | None:
    """e(z) and nu of k(|e(z) - e(z')|), inf for the squared exponential; None where k is not known to be so."""
    if type(kernel) in (RBFKernel, MaternKernel):
        smoothness = kernel.nu if isinstance(kernel, MaternKernel) else math.inf
        return partial(scaled, kernel), float(smoothness)
    squared_exponential = getattr(kernel, "squared_exponential_embedding", None)
    if type(kernel) is PeriodicKernel:
        squared_exponential = partial(_circles, kernel)
    if squared_exponential is not None:
        return squared_exponential, math.inf
    matern = getattr(kernel, "matern_embedding", None)
    return None if matern is None else (matern, float(cast(float, kernel.nu)))


def weight_features(kernel: Kernel) -> PointMap | None:
    """phi(z) with k = phi(z) . phi(z'), one entry per weight; None for kernels that are not known to be so."""
    if type(kernel) is LinearKernel:
        return lambda z: z * kernel.variance.reshape(-1).sqrt()
    if type(kernel) is ConstantKernel:
        return lambda z: kernel.constant.sqrt().reshape(1, 1).expand(len(z), 1)
    return getattr(kernel, "weight_features", None)


def _circles(kernel: PeriodicKernel, z: Tensor) -> Tensor:
    """e(x) = (cos, sin)(2 pi x / p) / sqrt l, for which 1/2 |e(x) - e(y)|^2 = 2 sin^2(pi (x - y) / p) / l."""
    angle = (2.0 * math.pi) * z / kernel.period_length.reshape(-1)
    return torch.cat([angle.cos(), angle.sin()], dim=-1) / lengthscale_of(kernel).sqrt().expand(z.shape[-1]).repeat(2)


def squared_exponential_parameters(kernel: Kernel) -> tuple[Tensor, Tensor] | None:
    """Length scales and output scale of a plain scaled squared exponential; None for every other kernel."""
    if type(kernel) is not ScaleKernel or type(kernel.base_kernel) is not RBFKernel:
        return None
    base = kernel.base_kernel
    if kernel.active_dims is not None or base.active_dims is not None or kernel.batch_shape or base.batch_shape:
        return None
    return lengthscale_of(base), cast(Tensor, kernel.outputscale)


def squared_distance(x: Float[Tensor, "n d"], y: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """|x_i - y_j|^2 by one matrix product, centred first: cancellation stays below 1e-14 for standardised inputs."""
    centre = y.mean(dim=0, keepdim=True) if y.shape[0] else 0.0
    x, y = x - centre, y - centre
    return (x.square().sum(-1)[:, None] + y.square().sum(-1)[None, :]).addmm(x, y.mT, alpha=-2.0).clamp_min(0.0)


def lengthscale_of(kernel: Kernel) -> Float[Tensor, " d"]:
    """Its length scales, one or one per feature."""
    return cast(Tensor, kernel.lengthscale).reshape(-1)


def scaled(kernel: Kernel, z: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
    """Features over the length scales of a kernel."""
    return z / lengthscale_of(kernel)


def of_distance(left: Tensor, right: Tensor, smoothness: float) -> Tensor:
    """The squared exponential (smoothness inf) or a Matern of the distances between points that are scaled already."""
    if smoothness == math.inf:
        return torch.exp(-0.5 * squared_distance(left, right))
    return _matern(distance(left, right), smoothness)


def distance(x: Float[Tensor, "n d"], y: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """|x_i - y_j| from the differences themselves: a root would make 1e-8 of what cancels in `squared_distance`."""
    return torch.cdist(x, y, compute_mode="donot_use_mm_for_euclid_dist")


def _matern(r: Tensor, smoothness: float) -> Tensor:
    """Rasmussen & Williams (2006), eq. 4.17, with scaled distances r."""
    a = math.sqrt(2.0 * smoothness) * r
    polynomial = {0.5: lambda: 1.0, 1.5: lambda: 1.0 + a, 2.5: lambda: 1.0 + a * (1.0 + a / 3.0)}[smoothness]()
    return polynomial * torch.exp(-a)


def _matern_slope(r: Tensor, smoothness: float) -> Tensor:
    """-2 dk/d(r^2); for smoothness 1/2 it grows as 1/r and counts as 0 where the points coincide."""
    a = math.sqrt(2.0 * smoothness) * r
    decay = torch.exp(-a)
    if smoothness == 0.5:
        return torch.where(r > NO_DISTANCE, decay / r, torch.zeros_like(r))
    return 3.0 * decay if smoothness == 1.5 else 5.0 / 3.0 * (1.0 + a) * decay


class StationaryMatrix(torch.autograd.Function):
    """s k(r) with r_ij = |(z_i - z_j) / l|: the squared exponential (smoothness inf) or a Matern.

    Has first derivatives only; saves nothing of size N x N but its result and, for a Matern, the derivative of it.
    """

    @staticmethod
    def forward(ctx, z: Tensor, lengthscale: Tensor, outputscale: Tensor, smoothness: float) -> Tensor:  # type: ignore[override]  # the base takes *args
        """The matrix (n, n)."""
        scaled = z / lengthscale
        if smoothness == math.inf:
            K = squared_distance(scaled, scaled).mul_(-0.5)
            K.diagonal().zero_()
            slope = K.exp_().mul_(outputscale)
        else:
            r = distance(scaled, scaled)
            K = _matern(r, smoothness).mul_(outputscale)
            slope = _matern_slope(r, smoothness).mul_(outputscale)
        ctx.save_for_backward(z, lengthscale, outputscale, K, slope)
        return K

    @staticmethod
    def backward(ctx, upstream: Tensor):  # type: ignore[override]  # the base takes *args
        """Gradients in z, length scales and output scale."""
        # With create_graph=True: `once_differentiable` would let it pass where upstream is a constant.
        if torch.is_grad_enabled():
            raise NotImplementedError(
                "this kernel matrix has first derivatives only; for a Hessian take finite differences of its gradient"
            )
        z, lengthscale, outputscale, K, slope = ctx.saved_tensors
        weighted = upstream * slope
        scaled = (z - z.mean(0)) / lengthscale  # centred, or features far from zero cancel below
        product = weighted @ scaled
        rows, columns = weighted.sum(1), weighted.sum(0)
        z_gradient = lengthscale_gradient = outputscale_gradient = None
        if ctx.needs_input_grad[2]:
            outputscale_gradient = (weighted.sum() if slope is K else (upstream * K).sum()) / outputscale
        if ctx.needs_input_grad[1]:
            # sum_ij G_ij slope_ij (x_id - x_jd)^2 / l_d^3, expanded so that only N x d arrays appear
            per_input = ((rows + columns)[:, None] * scaled.square()).sum(0) - 2.0 * (scaled * product).sum(0)
            lengthscale_gradient = per_input / lengthscale
            if lengthscale.numel() == 1:
                lengthscale_gradient = lengthscale_gradient.sum().reshape(lengthscale.shape)
        if ctx.needs_input_grad[0]:
            transposed = weighted.mT @ scaled
            z_gradient = (product + transposed - (rows + columns)[:, None] * scaled) / lengthscale
        return z_gradient, lengthscale_gradient, outputscale_gradient, None


class DenseKernel(ABC):
    """A kernel that is taken apart: its matrices, with the parameters that its modules hold at the call.

    Made once for a kernel by `taken_apart`, for the checks of what a kernel is cost more than small matrices do.
    """

    @abstractmethod
    def matrix(self, z: Float[Tensor, "n d"]) -> Float[Tensor, "n n"]:
        """k(z_i, z_j), of which there are first derivatives only."""

    @abstractmethod
    def cross(self, z: Float[Tensor, "n d"], other: Float[Tensor, "N d"]) -> Float[Tensor, "n N"]:
        """k(z_i, other_j)."""

    @abstractmethod
    def diagonal(self, z: Float[Tensor, "n d"]) -> Float[Tensor, " n"]:
        """k(z_i, z_i)."""


def taken_apart(kernel: Kernel) -> DenseKernel:
    """The kernel as sums, products and leaves whose formulas are evaluated here; any other kernel is called."""
    kind = type(kernel)
    if kernel.batch_shape or kernel.active_dims is not None:
        return _Called(kernel)
    if kind in (AdditiveKernel, ProductKernel):  # subclasses may have other formulas
        parts = [taken_apart(cast(Kernel, part)) for part in cast(AdditiveKernel, kernel).kernels]
        return _Composed(parts, add if kind is AdditiveKernel else mul)
    if isinstance(kernel, ScaleKernel) and kind is ScaleKernel:
        base = kernel.base_kernel  # whose active_dims are those of the scaled kernel
        plain = type(base) in (RBFKernel, MaternKernel) and not base.batch_shape
        return _OfDistance(base, kernel) if plain else _Composed([taken_apart(base)], scale=kernel)
    if embedding(kernel) is not None:
        return _OfDistance(kernel)
    return _Called(kernel) if weight_features(kernel) is None else _Weighted(kernel)


@dataclass(frozen=True, eq=False)
class _Called(DenseKernel):
    """A kernel of which nothing is known: GPyTorch evaluates it."""

    kernel: Kernel

    @override
    def matrix(self, z: Tensor) -> Tensor:
        return self.cross(z, z)

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        return self.kernel(z, other).to_dense()

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return cast(Tensor, self.kernel(z, z, diag=True))


@dataclass(frozen=True, eq=False)
class _Composed(DenseKernel):
    """A sum or a product of others, times the variance of `scale`."""

    parts: Sequence[DenseKernel]
    combine: Callable[[Tensor, Tensor], Tensor] = add
    scale: ScaleKernel | None = None

    @override
    def matrix(self, z: Tensor) -> Tensor:
        return self._composed([part.matrix(z) for part in self.parts])

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        return self._composed([part.cross(z, other) for part in self.parts])

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return self._composed([part.diagonal(z) for part in self.parts])

    def _composed(self, values: Sequence[Tensor]) -> Tensor:
        value = reduce(self.combine, values)
        return value if self.scale is None else self.scale.outputscale * value


@dataclass(frozen=True, eq=False)
class _OfDistance(DenseKernel):
    """A squared exponential or a Matern, also of the distance in an embedding; with an output scale if it has one."""

    kernel: Kernel
    scale: ScaleKernel | None = None

    @override
    def matrix(self, z: Tensor) -> Tensor:
        embed, lengthscale, smoothness = self._form(z)
        return cast(Tensor, StationaryMatrix.apply(embed(z), lengthscale, self._variance(z), smoothness))

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        embed, lengthscale, smoothness = self._form(z)
        return self._variance(z) * of_distance(embed(z) / lengthscale, embed(other) / lengthscale, smoothness)

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return self._variance(z).expand(len(z))

    def _form(self, z: Tensor) -> tuple[PointMap, Tensor, float]:
        """Embedding, length scales there, and smoothness."""
        found = embedding(self.kernel)
        assert found is not None, "taken_apart found it"
        if type(self.kernel) in (RBFKernel, MaternKernel):  # whose length scales have gradients written by hand
            return lambda points: points, lengthscale_of(self.kernel), found[1]
        return found[0], torch.ones(1, dtype=z.dtype, device=z.device), found[1]

    def _variance(self, z: Tensor) -> Tensor:
        if self.scale is None:
            return torch.ones((), dtype=z.dtype, device=z.device)
        return cast(Tensor, self.scale.outputscale)


@dataclass(frozen=True, eq=False)
class _Weighted(DenseKernel):
    """phi(z) . phi(z')."""

    kernel: Kernel

    @override
    def matrix(self, z: Tensor) -> Tensor:
        phi = self._features(z)
        return phi @ phi.mT

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        return self._features(z) @ self._features(other).mT

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return self._features(z).square().sum(-1)

    def _features(self, z: Tensor) -> Tensor:
        features = weight_features(self.kernel)
        assert features is not None, "taken_apart found them"
        return features(z)


class _Call(torch.nn.Module):
    """A function of kernels as a call of a module that holds them, so that `functional_call` covers all of it."""

    def __init__(self, kernels: torch.nn.Module, function: Callable[..., Any]) -> None:
        super().__init__()
        self.kernels, self.function = kernels, function

    def forward(self, *arguments: Any) -> Any:
        return self.function(*arguments)


class LatentKernels(torch.nn.Module):
    """One GPyTorch kernel per latent; parameters are read and replaced as one dictionary of unconstrained tensors.

    Raises InvalidInput for kernels that are not float64 (GPyTorch makes them float32).
    """

    def __init__(self, kernels: Iterable[Kernel]) -> None:
        super().__init__()
        self.kernels = torch.nn.ModuleList(kernels)
        self.dense: list[DenseKernel] = [taken_apart(kernel) for kernel in self]
        """The same kernels, taken apart: their matrices."""
        for name, value in self.named_parameters():
            if value.dtype != torch.float64:
                raise InvalidInput(f"{name} is {value.dtype}; inference needs float64, call .double() on the kernel.")

    def __iter__(self) -> Iterator[Kernel]:
        return iter(cast("list[Kernel]", list(self.kernels)))

    def __getitem__(self, index: int) -> Kernel:
        return cast(Kernel, self.kernels[index])

    def forward(self, features: Sequence[Float[Tensor, "N _"]]) -> list[Float[Tensor, "N N"]]:
        """One dense matrix per latent."""
        return [kernel.matrix(z) for kernel, z in zip(self.dense, features, strict=True)]

    def matrices(
        self, parameters: Mapping[str, Tensor], features: Sequence[Float[Tensor, "N _"]]
    ) -> list[Float[Tensor, "N N"]]:
        """The matrices at `parameters` (names as in `initial_parameters`), differentiable in them."""
        return self._at(parameters, lambda: self.forward(features))

    def crosses(
        self,
        parameters: Mapping[str, Tensor],
        left: Sequence[Float[Tensor, "_ _"]],
        right: Sequence[Float[Tensor, "_ _"]],
    ) -> list[Float[Tensor, "_ _"]]:
        """k_c(left_i, right_j) of every latent at `parameters`, differentiable in them."""
        return self._at(parameters, lambda: [k.cross(x, y) for k, x, y in zip(self.dense, left, right, strict=True)])

    def diagonals(
        self, parameters: Mapping[str, Tensor], features: Sequence[Float[Tensor, "_ _"]]
    ) -> list[Float[Tensor, " _"]]:
        """k_c(z_i, z_i) of every latent at `parameters`, differentiable in them."""
        return self._at(parameters, lambda: [k.diagonal(z) for k, z in zip(self.dense, features, strict=True)])

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """Log density of the GPyTorch priors registered on the kernels, at `parameters`; 0 where there are none."""
        return self._at(parameters, self._log_prior)

    def initial_parameters(self) -> dict[str, Tensor]:
        """The unconstrained parameters by name, detached copies."""
        return {name: value.detach().clone() for name, value in self.named_parameters()}

    def at(self, parameters: Mapping[str, Tensor]) -> "LatentKernels":
        """A copy that holds `parameters`, without gradients; this one is not changed."""
        return deepcopy(self).moved_to(parameters)

    def moved_to(self, parameters: Mapping[str, Tensor]) -> "LatentKernels":
        """These kernels themselves, which from now on hold `parameters`, without gradients: copies take long."""
        for name, value in self.named_parameters():
            value.requires_grad_(False)
            value.copy_(parameters[name].detach().reshape(value.shape))
        return self

    def _at(self, parameters: Mapping[str, Tensor], function: Callable[[], Any]) -> Any:
        """`function()` while these kernels have `parameters`."""
        named = {name: parameters[name] for name, _ in self.named_parameters()}
        return functional_call(_Call(self.kernels, function), named, ())

    def _log_prior(self) -> Tensor:
        named = [entry for kernel in self for entry in kernel.named_priors()]  # once where latents share a kernel
        priors = {(id(module), id(prior)): (module, prior, closure) for _, module, prior, closure, _ in named}
        total = torch.zeros((), dtype=torch.float64)
        for module, prior, closure in priors.values():
            value = prior.log_prob(closure(module)).sum()
            total = total.to(value.device) + value
        return total
