"""Dense kernel matrices of GPyTorch kernels, exact and lean: sums and products are taken apart into their leaves, once.

GPyTorch's own sums are not used: it adds a low-rank matrix (a linear kernel) to a dense one through a root
decomposition of the latter, which needs jitter where that is singular and is approximate where it is large. Its lazy
paths switch silently to conjugate gradients above N D = 800 (measured error of the predictive mean 7.9 rad/s^2 on the
iiwa).

The leaves: functions of the distance (squared exponential, Matern) have hand-written gradients, one N x N by N x d
product and no N x N x d tensor; linear and constant kernels, and those with one of the methods below, are matrix
products; every other kernel is called as it is, and once more in the backward pass. A kernel class may have one of

    squared_exponential_embedding(z) (n, e): then k(z, z') = exp(-1/2 |e(z) - e(z')|^2)
    matern_embedding(z) (n, e) and nu: then k(z, z') is the Matern of smoothness nu (1/2, 3/2, 5/2) of |e(z) - e(z')|
    weight_features(z) (n, p): then k(z, z') = phi(z) . phi(z')

both differentiable in z and in the kernel's parameters.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from operator import add, mul
from typing import cast

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
from torch.utils.checkpoint import checkpoint, set_checkpoint_early_stop
from typing_extensions import override

PointMap = Callable[[Tensor], Tensor]
"""Features (n, d) -> something (n, _) of every point."""

NO_DISTANCE = 1e-8
"""Scaled distance below which the derivative of a kernel with a kink at zero counts as zero."""

KNOWN = (
    AdditiveKernel,
    ProductKernel,
    ScaleKernel,
    RBFKernel,
    MaternKernel,
    PeriodicKernel,
    LinearKernel,
    ConstantKernel,
)
"""GPyTorch classes whose formulas are evaluated here; subclasses may have other formulas and are called."""


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
    inner = _inner(kernel)
    return inner if kernel.active_dims is None or isinstance(inner, _Called) else _Selected(kernel, inner)


def _inner(kernel: Kernel) -> DenseKernel:
    """The kernel on the features that it looks at."""
    if not _is_known(kernel):
        return _Called(kernel)
    if isinstance(kernel, AdditiveKernel | ProductKernel) and type(kernel) in KNOWN:
        parts = [taken_apart(cast(Kernel, part)) for part in kernel.kernels]
        return _Combined(add if type(kernel) is AdditiveKernel else mul, parts)
    if type(kernel) is ScaleKernel:
        base = kernel.base_kernel
        # active_dims of the base are those of the scaled kernel, which selects
        return (
            _Stationary(base, kernel) if type(base) in (RBFKernel, MaternKernel) else _Scaled(kernel, taken_apart(base))
        )
    if type(kernel) in (RBFKernel, MaternKernel):
        return _Stationary(kernel, None)
    if type(kernel) is ConstantKernel:
        return _Constant(kernel)
    return _Embedded(kernel) if embedding(kernel) is not None else _Weighted(kernel)


@dataclass(frozen=True, eq=False)
class _Called(DenseKernel):
    """A kernel of which nothing is known: GPyTorch evaluates it, and once more in the backward pass."""

    kernel: Kernel

    @override
    def matrix(self, z: Tensor) -> Tensor:
        return _recomputed(self.kernel, z) if torch.is_grad_enabled() else self.kernel(z, z).to_dense()

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        return self.kernel(z, other).to_dense()

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return cast(Tensor, self.kernel(z, z, diag=True))


@dataclass(frozen=True, eq=False)
class _Selected(DenseKernel):
    """A kernel of some of the features, its `active_dims`."""

    kernel: Kernel
    inner: DenseKernel

    @override
    def matrix(self, z: Tensor) -> Tensor:
        return self.inner.matrix(self._of(z))

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        return self.inner.cross(self._of(z), self._of(other))

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return self.inner.diagonal(self._of(z))

    def _of(self, z: Tensor) -> Tensor:
        return z.index_select(-1, cast(Tensor, self.kernel.active_dims))


@dataclass(frozen=True, eq=False)
class _Combined(DenseKernel):
    """A sum or a product."""

    combine: Callable[[Tensor, Tensor], Tensor]
    parts: Sequence[DenseKernel]

    @override
    def matrix(self, z: Tensor) -> Tensor:
        return reduce(self.combine, [part.matrix(z) for part in self.parts])

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        return reduce(self.combine, [part.cross(z, other) for part in self.parts])

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return reduce(self.combine, [part.diagonal(z) for part in self.parts])


@dataclass(frozen=True, eq=False)
class _Scaled(DenseKernel):
    """An output scale (variance) times another kernel."""

    kernel: ScaleKernel
    base: DenseKernel

    @override
    def matrix(self, z: Tensor) -> Tensor:
        return self.kernel.outputscale * self.base.matrix(z)

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        return self.kernel.outputscale * self.base.cross(z, other)

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return self.kernel.outputscale * self.base.diagonal(z)


@dataclass(frozen=True, eq=False)
class _Stationary(DenseKernel):
    """A squared exponential or a Matern, with an output scale where it has one."""

    kernel: Kernel
    scale: ScaleKernel | None

    @override
    def matrix(self, z: Tensor) -> Tensor:
        given = (z, _lengthscale(self.kernel), self._variance(z), self._smoothness)
        return cast(Tensor, _StationaryMatrix.apply(*given))

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        lengthscale = _lengthscale(self.kernel)
        return self._variance(z) * _of_distance(z / lengthscale, other / lengthscale, self._smoothness)

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return self._variance(z).expand(len(z))

    @property
    def _smoothness(self) -> float:
        return self.kernel.nu if isinstance(self.kernel, MaternKernel) else math.inf

    def _variance(self, z: Tensor) -> Tensor:
        if self.scale is None:
            return torch.ones((), dtype=z.dtype, device=z.device)
        return cast(Tensor, self.scale.outputscale)


@dataclass(frozen=True, eq=False)
class _Constant(DenseKernel):
    """The same covariance of all points."""

    kernel: ConstantKernel

    @override
    def matrix(self, z: Tensor) -> Tensor:
        return self.cross(z, z)

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        return self.kernel.constant.reshape(1, 1).expand(len(z), len(other)).contiguous()

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return self.kernel.constant.reshape(1).expand(len(z))


@dataclass(frozen=True, eq=False)
class _Embedded(DenseKernel):
    """A function of the distance in an embedding, with variance 1."""

    kernel: Kernel

    @override
    def matrix(self, z: Tensor) -> Tensor:
        embed, smoothness = self._embedding
        one = torch.ones(1, dtype=z.dtype, device=z.device)
        return cast(Tensor, _StationaryMatrix.apply(embed(z), one, one[0], smoothness))

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        embed, smoothness = self._embedding
        return _of_distance(embed(z), embed(other), smoothness)

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return torch.ones(len(z), dtype=z.dtype, device=z.device)

    @property
    def _embedding(self) -> tuple[PointMap, float]:
        found = embedding(self.kernel)
        assert found is not None, "taken_apart found one"
        return found


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


def squared_exponential_embedding(kernel: Kernel) -> PointMap | None:
    """e(z) with k = exp(-1/2 |e(z) - e(z')|^2); None for kernels that are not of that form, or not known to be."""
    if type(kernel) is PeriodicKernel:
        return partial(_circles, kernel)
    return getattr(kernel, "squared_exponential_embedding", None)


def embedding(kernel: Kernel) -> tuple[PointMap, float] | None:
    """e(z) and the smoothness nu of k as a function of |e(z) - e(z')|, infinite for the squared exponential.

    None for kernels that are not of that form, or not known to be.
    """
    squared_exponential = squared_exponential_embedding(kernel)
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
    return torch.cat([angle.cos(), angle.sin()], dim=-1) / _lengthscale(kernel).sqrt().expand(z.shape[-1]).repeat(2)


def squared_exponential_parameters(kernel: Kernel) -> tuple[Tensor, Tensor] | None:
    """Length scales and output scale of a plain scaled squared exponential; None for every other kernel."""
    if type(kernel) is not ScaleKernel or type(kernel.base_kernel) is not RBFKernel:
        return None
    base = kernel.base_kernel
    if kernel.active_dims is not None or base.active_dims is not None or kernel.batch_shape or base.batch_shape:
        return None
    return _lengthscale(base), cast(Tensor, kernel.outputscale)


def squared_distance(x: Float[Tensor, "n d"], y: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """|x_i - y_j|^2 by one matrix product, centred first: cancellation stays below 1e-14 for standardised inputs."""
    centre = y.mean(dim=0, keepdim=True) if y.shape[0] else 0.0
    x, y = x - centre, y - centre
    return (x.square().sum(-1)[:, None] + y.square().sum(-1)[None, :]).addmm(x, y.mT, alpha=-2.0).clamp_min(0.0)


def _is_known(kernel: Kernel) -> bool:
    """Whether its formula is evaluated here."""
    if kernel.batch_shape:
        return False
    if type(kernel) is ScaleKernel:
        # It takes over the `active_dims` of its base, which then does not select again.
        base = kernel.base_kernel
        return not base.batch_shape and (type(base) in (RBFKernel, MaternKernel) or kernel.active_dims is None)
    return type(kernel) in KNOWN or embedding(kernel) is not None or weight_features(kernel) is not None


def _lengthscale(kernel: Kernel) -> Tensor:
    return cast(Tensor, kernel.lengthscale).reshape(-1)


def _of_distance(left: Tensor, right: Tensor, smoothness: float) -> Tensor:
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


class _StationaryMatrix(torch.autograd.Function):
    """s k(r) with r_ij = |(z_i - z_j) / l|: the squared exponential (smoothness inf) or a Matern.

    Saves nothing of size N x N but its own result and, for a Matern, the derivative of it.
    """

    @staticmethod
    def forward(ctx, z: Tensor, lengthscale: Tensor, outputscale: Tensor, smoothness: float) -> Tensor:  # type: ignore[override]  # the base takes *args
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


def _recomputed(kernel: Kernel, z: Tensor) -> Tensor:
    """A kernel of any kind, called now and again in the backward pass, so that nothing of size N x N is kept."""
    dense = _DenseCall(kernel)
    # The parameters go in as arguments: by the time of the recomputation `functional_call` has put the module's own
    # ones back.
    names, values = zip(*dense.named_parameters(), strict=True) if list(dense.parameters()) else ((), ())
    # An early stop of the recomputation would leave GPyTorch's call by an exception, before it has put `active_dims`
    # back.
    with set_checkpoint_early_stop(False):
        return checkpoint(
            lambda points, *given: functional_call(dense, dict(zip(names, given, strict=True)), (points,)),
            z,
            *values,
            use_reentrant=False,
        )


class _DenseCall(torch.nn.Module):
    """A kernel whose call returns the dense matrix at once, so that `functional_call` covers the whole evaluation."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__()
        self.kernel = kernel

    def forward(self, z: Tensor) -> Tensor:
        return self.kernel(z, z).to_dense()
