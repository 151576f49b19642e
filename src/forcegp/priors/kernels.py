"""Kernels with start values. Any GPyTorch kernel may be used by a prior; these are the ones that the built-in priors share."""

from __future__ import annotations

import torch
from gpytorch.constraints import Positive
from gpytorch.kernels import RBFKernel, ScaleKernel
from torch import Tensor


def squared_exponential_kernel(dimension: int, lengthscale: float | Tensor, outputscale: float | Tensor) -> ScaleKernel:
    """A GPyTorch squared-exponential kernel with one length scale per input, both parameters optimised on a log scale.

    `lengthscale` (scalar or (dimension,)) and `outputscale` (variance) are the start values.
    """

    def positive() -> Positive:
        return Positive(transform=torch.exp, inv_transform=torch.log)

    kernel = ScaleKernel(
        RBFKernel(ard_num_dims=dimension, lengthscale_constraint=positive()), outputscale_constraint=positive()
    ).double()
    kernel.base_kernel.lengthscale = torch.as_tensor(lengthscale, dtype=torch.float64).expand(1, dimension)
    kernel.outputscale = torch.as_tensor(outputscale, dtype=torch.float64)
    return kernel
