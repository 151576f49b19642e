"""Exact Gaussian-process inference by deflation.

Knows mixing vectors, kernels, noise and targets; nothing of robots.
"""

from forcegp.inference.kernels import LatentKernels
from forcegp.inference.leave_out import LeaveOut, leave_blocks_out
from forcegp.inference.likelihood import negative_log_likelihood
from forcegp.inference.optimization import OptimizationResult, OptimizerOptions, best_of, minimize_objective
from forcegp.inference.posterior import ExactPosterior, LatentPosterior, exact

__all__ = [
    "ExactPosterior",
    "LatentKernels",
    "LatentPosterior",
    "LeaveOut",
    "OptimizationResult",
    "OptimizerOptions",
    "best_of",
    "exact",
    "leave_blocks_out",
    "minimize_objective",
    "negative_log_likelihood",
]
