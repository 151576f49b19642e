"""The kernels of all latents as one module: matrices, log prior, parameters by name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Any, cast

import torch
from gpytorch.kernels import Kernel
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call

from forcegp.errors import InvalidInput
from forcegp.inference.dense_kernels import DenseKernel, taken_apart


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
        return self._at(parameters, self, features)

    def crosses(
        self,
        parameters: Mapping[str, Tensor],
        left: Sequence[Float[Tensor, "_ _"]],
        right: Sequence[Float[Tensor, "_ _"]],
    ) -> list[Float[Tensor, "_ _"]]:
        """k_c(left_i, right_j) of every latent at `parameters`, differentiable in them."""
        return self._at(parameters, _Crosses(self), left, right)

    def diagonals(
        self, parameters: Mapping[str, Tensor], features: Sequence[Float[Tensor, "_ _"]]
    ) -> list[Float[Tensor, " _"]]:
        """k_c(z_i, z_i) of every latent at `parameters`, differentiable in them."""
        return self._at(parameters, _Diagonals(self), features)

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """Log density of the GPyTorch priors registered on the kernels, at `parameters`; 0 where there are none."""
        return self._at(parameters, _LogPrior(self))

    def initial_parameters(self) -> dict[str, Tensor]:
        """The unconstrained parameters by name, detached copies."""
        return {name: value.detach().clone() for name, value in self.named_parameters()}

    def at(self, parameters: Mapping[str, Tensor]) -> LatentKernels:
        """A copy that holds `parameters`, without gradients; this one is not changed."""
        return deepcopy(self).moved_to(parameters)

    def moved_to(self, parameters: Mapping[str, Tensor]) -> LatentKernels:
        """These kernels themselves, which from now on hold `parameters`, without gradients: copies take long."""
        for name, value in self.named_parameters():
            value.requires_grad_(False)
            value.copy_(parameters[name].detach().reshape(value.shape))
        return self

    def _at(self, parameters: Mapping[str, Tensor], what: torch.nn.Module, *arguments: object) -> Any:
        """`what(*arguments)`, a module that holds these kernels under the same names, at `parameters`."""
        return functional_call(what, {name: parameters[name] for name, _ in self.named_parameters()}, arguments)


class _Crosses(torch.nn.Module):
    def __init__(self, latent: LatentKernels) -> None:
        super().__init__()
        self.kernels, self.dense = latent.kernels, latent.dense

    def forward(self, left: Sequence[Tensor], right: Sequence[Tensor]) -> list[Tensor]:
        return [kernel.cross(x, y) for kernel, x, y in zip(self.dense, left, right, strict=True)]


class _Diagonals(torch.nn.Module):
    def __init__(self, latent: LatentKernels) -> None:
        super().__init__()
        self.kernels, self.dense = latent.kernels, latent.dense

    def forward(self, features: Sequence[Tensor]) -> list[Tensor]:
        return [kernel.diagonal(z) for kernel, z in zip(self.dense, features, strict=True)]


class _LogPrior(torch.nn.Module):
    """Sum of the log densities of all priors that are registered on some kernels, once where latents share a kernel."""

    def __init__(self, latent: LatentKernels) -> None:
        super().__init__()
        self.kernels = latent.kernels
        named = [entry for kernel in latent for entry in kernel.named_priors()]
        self.priors = {(id(module), id(prior)): (module, prior, closure) for _, module, prior, closure, _ in named}

    def forward(self) -> Tensor:
        total = torch.zeros((), dtype=torch.float64)
        for module, prior, closure in self.priors.values():
            value = prior.log_prob(closure(module)).sum()
            total = total.to(value.device) + value
        return total
