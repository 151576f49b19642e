"""Kernels of all latents: matrices of GPyTorch kernels, exact and lean, and their parameters by name.

A kernel class of anybody may have `matern_embedding(z)` (n, e) and `nu` (inf: k = exp(-1/2 |e - e'|^2)), or
`weight_features(z)` (n, p), for k = phi . phi'. Every other kernel is called.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from functools import cached_property, partial, reduce
from operator import add, mul
from typing import Any, NamedTuple, cast

import torch
from gpytorch import kernels as gp
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call

from forcegp.errors import InvalidInput

PointMap = Callable[[Tensor], Tensor]
"""Features (n, d) -> something (n, _) of every point."""


def embedding(kernel: Kernel) -> tuple[PointMap, float] | None:
    """e(z) and nu of k(|e(z) - e(z')|), inf for the squared exponential; None where k is not known to be so."""
    if type(kernel) in (gp.RBFKernel, gp.MaternKernel):
        return partial(scaled, kernel), float(kernel.nu if isinstance(kernel, gp.MaternKernel) else math.inf)
    matern = getattr(kernel, "matern_embedding", None)
    return None if matern is None else (matern, float(cast(float, kernel.nu)))


def weight_features(kernel: Kernel) -> PointMap | None:
    """phi(z) with k = phi(z) . phi(z'), one entry per weight; None for kernels that are not known to be so."""
    if type(kernel) is gp.LinearKernel:
        return lambda z: z * kernel.variance.reshape(-1).sqrt()
    if type(kernel) is gp.ConstantKernel:
        return lambda z: kernel.constant.sqrt().reshape(1, 1).expand(len(z), 1)
    return getattr(kernel, "weight_features", None)


def squared_exponential_parameters(kernel: Kernel) -> tuple[Tensor, Tensor] | None:
    """Length scales and output scale of a plain scaled squared exponential; None for every other kernel."""
    if type(kernel) is not gp.ScaleKernel or type(kernel.base_kernel) is not gp.RBFKernel:
        return None
    base = kernel.base_kernel
    if kernel.active_dims is not None or base.active_dims is not None or kernel.batch_shape or base.batch_shape:
        return None
    return lengthscale_of(base), cast(Tensor, kernel.outputscale)


def squared_distance(x: Float[Tensor, "n d"], y: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """|x_i - y_j|^2 by one matrix product, centred first: cancellation stays below 1e-14 for standardised inputs."""
    centre = y.mean(dim=0, keepdim=True) if y.shape[0] else 0.0
    left, right = x - centre, y - centre
    d2 = (left.square().sum(-1)[:, None] + right.square().sum(-1)[None, :]).addmm(left, right.mT, alpha=-2.0)
    if x is y:  # 0 to the last bit, as the variance of a point is the output scale
        d2 = d2.masked_fill(torch.eye(len(x), dtype=torch.bool, device=x.device), 0.0)
    return d2.clamp_min(0.0)


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
    # from the differences themselves: a root would make 1e-8 of what cancels in `squared_distance`
    r = torch.cdist(left, right, compute_mode="donot_use_mm_for_euclid_dist")
    a = math.sqrt(2.0 * smoothness) * r  # Rasmussen & Williams (2006), eq. 4.17
    polynomial = {0.5: lambda: 1.0, 1.5: lambda: 1.0 + a, 2.5: lambda: 1.0 + a * (1.0 + a / 3.0)}[smoothness]()
    return polynomial * torch.exp(-a)


class DenseKernel(NamedTuple):
    """A kernel that is taken apart: k(z_i, other_j) and k(z_i, z_i), with the parameters of its modules at the call.

    Made once for a kernel, for the checks of what a kernel is cost more than small matrices do.
    """

    cross: Callable[[Tensor, Tensor], Tensor]
    diagonal: Callable[[Tensor], Tensor]


def taken_apart(kernel: Kernel) -> DenseKernel:
    """The kernel as sums, products and leaves whose formulas are evaluated here; any other kernel is called."""
    kind, found, phi = type(kernel), None, None
    if not kernel.batch_shape and kernel.active_dims is None:
        if kind in (gp.AdditiveKernel, gp.ProductKernel):  # subclasses may have other formulas
            parts = [taken_apart(cast(Kernel, part)) for part in cast(gp.AdditiveKernel, kernel).kernels]
            combine: Callable[[Tensor, Tensor], Tensor] = add if kind is gp.AdditiveKernel else mul
            return DenseKernel(
                lambda z, other: reduce(combine, [part.cross(z, other) for part in parts]),
                lambda z: reduce(combine, [part.diagonal(z) for part in parts]),
            )
        if isinstance(kernel, gp.ScaleKernel) and kind is gp.ScaleKernel:
            base = taken_apart(kernel.base_kernel)
            return DenseKernel(
                lambda z, other: cast(Tensor, kernel.outputscale) * base.cross(z, other),
                lambda z: cast(Tensor, kernel.outputscale) * base.diagonal(z),
            )
        found, phi = embedding(kernel), weight_features(kernel)
    if found is not None:
        embed, smoothness = found

        def cross(z: Tensor, other: Tensor) -> Tensor:
            right = embed(other)
            return of_distance(right if z is other else embed(z), right, smoothness)

        return DenseKernel(cross, lambda z: z.new_ones(len(z)))
    if phi is not None:
        return DenseKernel(lambda z, other: phi(z) @ phi(other).mT, lambda z: phi(z).square().sum(-1))
    return DenseKernel(lambda z, other: kernel(z, other).to_dense(), lambda z: cast(Tensor, kernel(z, z, diag=True)))


class LatentKernels(torch.nn.Module):
    """One GPyTorch kernel per latent; parameters are read and replaced as one dictionary of unconstrained tensors.

    Raises InvalidInput for kernels that are not float64 (GPyTorch makes them float32).
    """

    def __init__(self, kernels: Iterable[Kernel]) -> None:
        super().__init__()
        self.kernels = torch.nn.ModuleList(kernels)
        for name, value in self.named_parameters():
            if value.dtype != torch.float64:
                raise InvalidInput(f"{name} is {value.dtype}; inference needs float64, call .double() on the kernel.")

    @cached_property
    def dense(self) -> list[DenseKernel]:
        """The same kernels, taken apart."""
        return [taken_apart(kernel) for kernel in self]

    def __getstate__(self) -> dict[str, Any]:
        return {name: x for name, x in vars(self).items() if name != "dense"}  # a copy takes its own kernels apart

    def __iter__(self) -> Iterator[Kernel]:
        return iter(cast("list[Kernel]", list(self.kernels)))

    def __getitem__(self, index: int) -> Kernel:
        return cast(Kernel, self.kernels[index])

    def forward(self, features: Sequence[Float[Tensor, "N _"]], function: Callable[[], Any] | None = None) -> Any:
        """One dense matrix (N, N) per latent, or what the `function` returns, so that `functional_call` covers it."""
        if function is not None:
            return function()
        return [kernel.cross(z, z) for kernel, z in zip(self.dense, features, strict=True)]

    def matrices(
        self, parameters: Mapping[str, Tensor], features: Sequence[Float[Tensor, "N _"]]
    ) -> list[Float[Tensor, "N N"]]:
        """The matrices at `parameters` (names as in `initial_parameters`), differentiable in them."""
        return self._at(parameters, features)

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """Log density of the GPyTorch priors registered on the kernels, at `parameters`; 0 where there are none."""
        return self._at(parameters, (), self._log_prior)

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

    def _at(self, parameters: Mapping[str, Tensor], *arguments: Any) -> Any:
        """`forward` while these kernels have `parameters`."""
        return functional_call(self, {name: parameters[name] for name, _ in self.named_parameters()}, arguments)

    def _log_prior(self) -> Tensor:
        named = [entry for kernel in self for entry in kernel.named_priors()]  # once where latents share a kernel
        priors = {(id(module), id(prior)): (module, prior, closure) for _, module, prior, closure, _ in named}
        total = torch.zeros((), dtype=torch.float64)
        for module, prior, closure in priors.values():
            value = prior.log_prob(closure(module)).sum()
            total = total.to(value.device) + value
        return total
