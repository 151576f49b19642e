"""Positive kernel parameters that are searched on a log scale, and normal priors on their logarithms."""

from __future__ import annotations

from functools import partial

import torch
from gpytorch import Module
from gpytorch.constraints import Positive
from gpytorch.priors import NormalPrior
from torch import Tensor

LOG_VARIANCE_SPREAD = 2.0
"""Standard deviation of the prior on the logarithm of the variance of a weight (linear, constant, friction): the
likelihood is flat below the noise, where a variance could run off to zero and never come back.
"""


def log_scale() -> Positive:
    """The constraint of a positive parameter that is stored as its logarithm."""
    return Positive(transform=torch.exp, inv_transform=torch.log)  # type: ignore[arg-type]  # stubs want a Softplus


def float64(value: float | Tensor) -> Tensor:
    """A detached tensor; a Python number given to GPyTorch would be rounded to float32 on the way."""
    return torch.as_tensor(value, dtype=torch.float64).detach().clone()


def register_log_normal_prior(module: Module, name: str, center: float | Tensor, spread: float) -> None:
    """log p ~ N(log center, spread^2) for the positive parameter `name` of a kernel; entries are independent.

    `center` has the shape of the parameter or is one number. The density is that of the logarithm, so that its mode is
    `center` for a search on the log scale.
    """
    loc = float64(center).log()
    prior = NormalPrior(loc, torch.full_like(loc, spread))
    module.register_prior(f"{name}_prior", prior, partial(_log_parameter, name))


def _log_parameter(name: str, module: Module) -> Tensor:
    return getattr(module, name).log()
