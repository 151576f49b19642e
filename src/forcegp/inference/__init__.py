"""Gaussian-process inference, exact by deflation, and for many rows by conjugate gradients or inducing points.

Knows mixing vectors, kernels, noise and targets; nothing of robots.
"""

from forcegp.inference.block_cross_validation import LeaveOut, leave_blocks_out
from forcegp.inference.engines import (
    ENGINES,
    Choice,
    Engine,
    Exact,
    Inducing,
    Iterative,
    ProblemSize,
    Stochastic,
    choose_engine,
    engine_from_dict,
    engine_of,
)
from forcegp.inference.inducing import InducingPosterior, collapsed_bound
from forcegp.inference.iterative import IterativePosterior
from forcegp.inference.kernels import LatentKernels
from forcegp.inference.likelihood import negative_log_likelihood
from forcegp.inference.linear_functionals import FunctionalPosterior
from forcegp.inference.optimization import OptimizationResult, OptimizerOptions, best_of, minimize_objective
from forcegp.inference.posterior import ExactPosterior, LatentPosterior, exact
from forcegp.inference.terms import Terms

__all__ = [
    "ENGINES",
    "Choice",
    "Engine",
    "Exact",
    "ExactPosterior",
    "FunctionalPosterior",
    "Inducing",
    "InducingPosterior",
    "Iterative",
    "IterativePosterior",
    "LatentKernels",
    "LatentPosterior",
    "LeaveOut",
    "OptimizationResult",
    "OptimizerOptions",
    "ProblemSize",
    "Stochastic",
    "Terms",
    "best_of",
    "choose_engine",
    "collapsed_bound",
    "engine_from_dict",
    "engine_of",
    "exact",
    "leave_blocks_out",
    "minimize_objective",
    "negative_log_likelihood",
]
