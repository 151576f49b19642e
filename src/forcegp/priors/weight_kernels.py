"""Kernels of functions with finitely many unknown weights: a constant and a linear function."""

from __future__ import annotations

from gpytorch.kernels import ConstantKernel, LinearKernel
from torch import Tensor

from forcegp.priors.kernel_parameters import LOG_VARIANCE_SPREAD, float64, log_scale, register_log_normal_prior


def linear(dimension: int, variance: float | Tensor) -> LinearKernel:
    """k = sum_d s_d z_d z'_d: a linear function through zero whose weights have variances s_d (GPyTorch: `variance`).

    They start at variance / dimension, so that standardised features give `variance` together, each with the prior
    log s_d ~ N(log of its start value, 2^2).
    """
    kernel = LinearKernel(ard_num_dims=dimension, variance_constraint=log_scale()).double()
    start = float64(variance) / dimension
    kernel.variance = start.expand(1, dimension)
    register_log_normal_prior(kernel, "variance", start, LOG_VARIANCE_SPREAD)
    return kernel


def constant(dimension: int, variance: float | Tensor) -> ConstantKernel:
    """k = c: one unknown number of variance c, which starts at `variance`, log c ~ N(log variance, 2^2)."""
    kernel = ConstantKernel(constant_constraint=log_scale()).double()
    kernel.constant = float64(variance)
    register_log_normal_prior(kernel, "constant", variance, LOG_VARIANCE_SPREAD)
    return kernel
