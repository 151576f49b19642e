"""Kernels with start values.

Any GPyTorch kernel may be used by a prior; these are the ones that the built-in priors share.
"""

from __future__ import annotations

import math

import torch
from gpytorch.constraints import Positive
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.priors import NormalPrior
from torch import Tensor

LOG_LENGTHSCALE_SHIFT = 3.0
LOG_LENGTHSCALE_SPREAD = 2.0


def squared_exponential_kernel(dimension: int, lengthscale: float | Tensor, outputscale: float | Tensor) -> ScaleKernel:
    """A GPyTorch squared-exponential kernel with one length scale per input, both parameters optimised on a log scale.

    `lengthscale` (scalar or (dimension,)) and `outputscale` (variance) are the start values. The length scales carry a
    wide normal prior on their logarithm, N(log sqrt(dimension) + 3, 2^2), for standardised inputs: most inputs matter
    little to most forces, and with fewer points than parameters plain maximum likelihood finds relevance by chance. It
    is the dimension-scaled prior of Hvarfner et al. (2024), shifted to longer and made wider; measured in
    docs/architecture.md.
    """

    def positive() -> Positive:
        return Positive(transform=torch.exp, inv_transform=torch.log)  # type: ignore[arg-type]  # stubs want a Softplus

    kernel = ScaleKernel(
        RBFKernel(ard_num_dims=dimension, lengthscale_constraint=positive()), outputscale_constraint=positive()
    ).double()
    kernel.base_kernel.register_prior(
        "lengthscale_prior",
        NormalPrior(_scalar(0.5 * math.log(dimension) + LOG_LENGTHSCALE_SHIFT), _scalar(LOG_LENGTHSCALE_SPREAD)),
        _log_lengthscale,
    )
    kernel.base_kernel.lengthscale = torch.as_tensor(lengthscale, dtype=torch.float64).expand(1, dimension)
    kernel.outputscale = torch.as_tensor(outputscale, dtype=torch.float64)
    return kernel


def _log_lengthscale(kernel: RBFKernel) -> Tensor:
    return kernel.lengthscale.log()


def _scalar(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)  # a Python number would be rounded to float32 on the way
