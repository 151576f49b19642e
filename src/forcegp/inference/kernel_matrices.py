"""Formulas of kernels: functions of a distance with hand-written gradients, and what is known of GPyTorch's classes.

Functions of the distance (squared exponential, Matern) need one N x N by N x d product and no N x N x d tensor in the
backward pass. A kernel class of anybody may have one of

    squared_exponential_embedding(z) (n, e): then k(z, z') = exp(-1/2 |e(z) - e(z')|^2)
    matern_embedding(z) (n, e) and nu: then k(z, z') is the Matern of smoothness nu (1/2, 3/2, 5/2) of |e(z) - e(z')|
    weight_features(z) (n, p): then k(z, z') = phi(z) . phi(z')

all differentiable in z and in the kernel's parameters.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import cast

import torch
from gpytorch.kernels import ConstantKernel, Kernel, LinearKernel, MaternKernel, PeriodicKernel, RBFKernel, ScaleKernel
from jaxtyping import Float
from torch import Tensor

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
