"""Kernel matrices of GPyTorch kernels, evaluated lean in memory.

GPyTorch's own lazy paths are not used: above N D = 800 they switch silently to conjugate gradients (measured error of
the predictive mean 7.9 rad/s^2 on the iiwa). Kernels are called densely. The squared exponential, which almost every
model uses, has hand- written gradients: one N x N by N x d product per latent and no N x N x d tensor; other kernels
are recomputed in the backward pass, one latent at a time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from typing import cast

import torch
from gpytorch.kernels import Kernel, RBFKernel, ScaleKernel
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call
from torch.utils.checkpoint import checkpoint, set_checkpoint_early_stop

from forcegp.errors import InvalidInput


def kernel_matrix(kernel: Kernel, z: Float[Tensor, "N d"]) -> Float[Tensor, "N N"]:
    """k(z_i, z_j), dense and differentiable in the kernel's parameters and in z."""
    squared_exponential = squared_exponential_parameters(kernel)
    if squared_exponential is not None:
        return cast(Tensor, _SquaredExponential.apply(z, *squared_exponential))
    if not torch.is_grad_enabled():
        return kernel(z, z).to_dense()
    dense = _DenseKernel(kernel)
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


def kernel_cross(kernel: Kernel, z: Float[Tensor, "n d"], z_train: Float[Tensor, "N d"]) -> Float[Tensor, "n N"]:
    """k(z_i, z_train_j), dense."""
    squared_exponential = squared_exponential_parameters(kernel)
    if squared_exponential is not None:
        lengthscale, outputscale = squared_exponential
        return outputscale * torch.exp(-0.5 * _squared_distance(z / lengthscale, z_train / lengthscale))
    return kernel(z, z_train).to_dense()


def kernel_diagonal(kernel: Kernel, z: Float[Tensor, "n d"]) -> Float[Tensor, "n"]:
    """k(z_i, z_i)."""
    return cast(Tensor, kernel(z, z, diag=True))


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

    def __iter__(self) -> Iterator[Kernel]:
        return iter(cast("list[Kernel]", list(self.kernels)))

    def forward(self, features: Sequence[Float[Tensor, "N _"]]) -> list[Float[Tensor, "N N"]]:
        """One dense matrix per latent."""
        return [kernel_matrix(kernel, z) for kernel, z in zip(self, features, strict=True)]

    def matrices(
        self, parameters: Mapping[str, Tensor], features: Sequence[Float[Tensor, "N _"]]
    ) -> list[Float[Tensor, "N N"]]:
        """The matrices at `parameters` (names as in `initial_parameters`), differentiable in them."""
        return functional_call(self, {name: parameters[name] for name, _ in self.named_parameters()}, (features,))

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """Log density of the GPyTorch priors registered on the kernels, at `parameters`; 0 where there are none."""
        return functional_call(_LogPrior(self), {n: parameters[n] for n, _ in self.named_parameters()}, ())

    def initial_parameters(self) -> dict[str, Tensor]:
        """The unconstrained parameters by name, detached copies."""
        return {name: value.detach().clone() for name, value in self.named_parameters()}

    def at(self, parameters: Mapping[str, Tensor]) -> LatentKernels:
        """A copy that holds `parameters`, without gradients; this one is not changed."""
        copy = deepcopy(self)
        for name, value in copy.named_parameters():
            value.data = parameters[name].detach().clone().reshape(value.shape)
            value.requires_grad_(False)
        return copy


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


class _DenseKernel(torch.nn.Module):
    """A kernel whose call returns the dense matrix at once, so that `functional_call` covers the whole evaluation."""

    def __init__(self, kernel: Kernel) -> None:
        super().__init__()
        self.kernel = kernel

    def forward(self, z: Tensor) -> Tensor:
        return self.kernel(z, z).to_dense()


def squared_exponential_parameters(kernel: Kernel) -> tuple[Tensor, Tensor] | None:
    """Length scales and output scale of a plain scaled squared exponential; None for every other kernel."""
    if type(kernel) is not ScaleKernel or type(kernel.base_kernel) is not RBFKernel:
        return None
    base = kernel.base_kernel
    if kernel.active_dims is not None or base.active_dims is not None or kernel.batch_shape or base.batch_shape:
        return None
    return cast(Tensor, base.lengthscale).reshape(-1), cast(Tensor, kernel.outputscale)


def _squared_distance(x: Float[Tensor, "n d"], y: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """|x_i - y_j|^2 by one matrix product, centred first: cancellation stays below 1e-14 for standardised inputs."""
    centre = y.mean(dim=0, keepdim=True) if y.shape[0] else 0.0
    x, y = x - centre, y - centre
    return (x.square().sum(-1)[:, None] + y.square().sum(-1)[None, :]).addmm(x, y.mT, alpha=-2.0).clamp_min(0.0)


class _SquaredExponential(torch.autograd.Function):
    """s exp(-1/2 |z_i - z_j|^2 / l^2); saves nothing of size N x N but its own result."""

    @staticmethod
    def forward(ctx, z: Tensor, lengthscale: Tensor, outputscale: Tensor) -> Tensor:  # type: ignore[override]
        scaled = z / lengthscale
        K = _squared_distance(scaled, scaled).mul_(-0.5)
        K.diagonal().zero_()
        K.exp_().mul_(outputscale)
        ctx.save_for_backward(z, lengthscale, outputscale, K)
        return K

    @staticmethod
    def backward(ctx, upstream: Tensor):  # type: ignore[override]
        # With create_graph=True: `once_differentiable` would let it pass where upstream is a constant.
        if torch.is_grad_enabled():
            raise NotImplementedError(
                "this kernel matrix has first derivatives only; for a Hessian take finite differences of its gradient"
            )
        z, lengthscale, outputscale, K = ctx.saved_tensors
        weighted = upstream * K
        scaled = (z - z.mean(0)) / lengthscale  # centred, or features far from zero cancel below
        product = weighted @ scaled
        rows, columns = weighted.sum(1), weighted.sum(0)
        z_gradient = lengthscale_gradient = None
        if ctx.needs_input_grad[1]:
            # sum_ij G_ij K_ij (x_id - x_jd)^2 / l_d^3, expanded so that only N x d arrays appear
            per_input = ((rows + columns)[:, None] * scaled.square()).sum(0) - 2.0 * (scaled * product).sum(0)
            lengthscale_gradient = per_input / lengthscale
            if lengthscale.numel() == 1:
                lengthscale_gradient = lengthscale_gradient.sum().reshape(lengthscale.shape)
        if ctx.needs_input_grad[0]:
            transposed = weighted.mT @ scaled
            z_gradient = (product + transposed - (rows + columns)[:, None] * scaled) / lengthscale
        return z_gradient, lengthscale_gradient, weighted.sum() / outputscale
