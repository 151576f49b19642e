"""Kernels of all latents: matrices of GPyTorch kernels, exact and lean, and their parameters by name.

GPyTorch's own sums are not used: it adds a low-rank matrix (a linear kernel) to a dense one through a root
decomposition of the latter, which needs jitter where that is singular and is approximate where it is large. Its lazy
paths switch silently to conjugate gradients above N D = 800 (an error of the mean of 7.9 rad/s^2 on the iiwa).

Functions of the distance, linear and constant kernels, and those with an embedding or weight features
(`kernel_matrices`) are evaluated here; every other kernel is called as it is, and once more in the backward pass.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import reduce
from operator import add, mul
from typing import Any, cast

import torch
from gpytorch.kernels import AdditiveKernel, Kernel, MaternKernel, ProductKernel, RBFKernel, ScaleKernel
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call
from torch.utils.checkpoint import checkpoint, set_checkpoint_early_stop
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.inference.kernel_matrices import (
    PointMap,
    StationaryMatrix,
    embedding,
    lengthscale_of,
    of_distance,
    weight_features,
)

COMBINED = (AdditiveKernel, ProductKernel)
"""Of GPyTorch, of which subclasses may have other formulas and are called."""


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
    return inner if kernel.active_dims is None or isinstance(inner, _Called) else _Composed([inner], of=kernel)


def _inner(kernel: Kernel) -> DenseKernel:
    """The kernel on the features that it looks at."""
    if not _is_known(kernel):
        return _Called(kernel)
    if isinstance(kernel, AdditiveKernel | ProductKernel) and type(kernel) in COMBINED:
        parts = [taken_apart(cast(Kernel, part)) for part in kernel.kernels]
        return _Composed(parts, add if type(kernel) is AdditiveKernel else mul)
    if type(kernel) is ScaleKernel:
        base = kernel.base_kernel
        # active_dims of the base are those of the scaled kernel, which selects
        plain = type(base) in (RBFKernel, MaternKernel)
        return _OfDistance(base, kernel) if plain else _Composed([taken_apart(base)], scale=kernel)
    return _Weighted(kernel) if embedding(kernel) is None else _OfDistance(kernel)


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
class _Composed(DenseKernel):
    """A sum or a product of others, times the variance of `scale`, of the features that `of` looks at."""

    parts: Sequence[DenseKernel]
    combine: Callable[[Tensor, Tensor], Tensor] = add
    scale: ScaleKernel | None = None
    of: Kernel | None = None

    @override
    def matrix(self, z: Tensor) -> Tensor:
        return self._composed("matrix", z)

    @override
    def cross(self, z: Tensor, other: Tensor) -> Tensor:
        return self._composed("cross", z, other)

    @override
    def diagonal(self, z: Tensor) -> Tensor:
        return self._composed("diagonal", z)

    def _composed(self, what: str, *points: Tensor) -> Tensor:
        if self.of is not None:
            points = tuple(z.index_select(-1, cast(Tensor, self.of.active_dims)) for z in points)
        value = reduce(self.combine, [getattr(part, what)(*points) for part in self.parts])
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


def _is_known(kernel: Kernel) -> bool:
    """Whether its formula is evaluated here."""
    if kernel.batch_shape:
        return False
    if type(kernel) is ScaleKernel:
        # It takes over the `active_dims` of its base, which then does not select again.
        base = kernel.base_kernel
        return not base.batch_shape and (type(base) in (RBFKernel, MaternKernel) or kernel.active_dims is None)
    return type(kernel) in COMBINED or embedding(kernel) is not None or weight_features(kernel) is not None


def _recomputed(kernel: Kernel, z: Tensor) -> Tensor:
    """A kernel of any kind, called now and again in the backward pass, so that nothing of size N x N is kept."""
    dense = _Call(kernel, lambda z: kernel(z, z).to_dense())
    # As arguments: by the time of the recomputation `functional_call` has put the module's own parameters back.
    names, values = zip(*dense.named_parameters(), strict=True) if list(dense.parameters()) else ((), ())
    # An early stop would leave GPyTorch's call by an exception, before it has put `active_dims` back.
    with set_checkpoint_early_stop(False):
        return checkpoint(
            lambda points, *given: functional_call(dense, dict(zip(names, given, strict=True)), (points,)),
            z,
            *values,
            use_reentrant=False,
        )


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
