"""Latents of one input in pieces, against sums of kernel functions."""

import ctypes
import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from tests.inference.problems import normal

from forcegp.codegen import native_code
from forcegp.errors import CompilerError
from forcegp.inference import ExactPosterior, LatentKernels
from forcegp.inference.one_input_functions import MarkovFunctions, drawn_form, markov_functions, one_input_form
from forcegp.inference.pathwise import draw_functions
from forcegp.inference.piecewise_tables import SEARCH, CubicTable, OneInputFunctions, cubic_table
from forcegp.priors.kernels import kernel_of

EXACT = [
    "friction",
    "matern-1/2",
    "matern-3/2",
    "matern-5/2",
    "linear",
    "constant",
    "linear * matern-5/2 + constant",
    "friction * (constant + linear) + matern-3/2 + matern-1/2",
]
TABLES = ["squared-exponential", "rational-quadratic", "periodic", "deep", "squared-exponential * linear + matern-3/2"]

# the macros of the C writer, for one state and for eight
ONE = """#include <math.h>
#include <stddef.h>
typedef double real;
#define LANES 1
#define AT(x, k) (x)
#define r_exp exp
#define r_tanh tanh
#define r_asinh asinh
#define r_sqrt sqrt
"""
EIGHT = """#include <math.h>
#include <stddef.h>
typedef double real __attribute__((vector_size(64)));
#define LANES 8
#define AT(x, k) ((x)[k])
#define EACH(f) static real r_##f(real x) { real y; for (int k = 0; k < 8; ++k) y[k] = f(x[k]); return y; }
EACH(exp) EACH(tanh) EACH(asinh) EACH(sqrt)
"""
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")


@dataclass
class Latents:
    """What the forms need of a posterior, with weights of our choice."""

    kernels: LatentKernels
    features: tuple[torch.Tensor, ...]
    weights: tuple[torch.Tensor, ...]


def latents(expression: str, centers: torch.Tensor, weights: torch.Tensor | None = None, scale: float | None = None):
    kernels = LatentKernels([kernel_of(expression, 1, 2.0)])
    with torch.no_grad():
        for name, value in kernels.named_parameters():
            if scale is not None and name.endswith("lengthscale"):
                value.fill_(math.log(scale))
    kernels.requires_grad_(False)
    weights = normal(len(centers), seed=8) if weights is None else weights
    return Latents(kernels, (centers[:, None],), (weights,))


def summed(given, s: torch.Tensor) -> torch.Tensor:
    return given.kernels.dense[0].cross(s[:, None], given.features[0]) @ given.weights[0]


def points(centers: torch.Tensor) -> torch.Tensor:
    """In their range, far beyond it, at centres and near zero."""
    spread = centers.abs().max()
    return torch.cat([torch.linspace(-3, 3, 61) * spread, 1e3 * spread[None], centers, torch.tensor([0.0, 1e-9, -1e-9])])


@pytest.mark.parametrize("count", [1, 2, 30])
@pytest.mark.parametrize("expression", EXACT)
def test_exact_forms_are_the_sums(expression, count):
    given = latents(expression, normal(count, seed=3))
    form = one_input_form(given, 0)
    assert isinstance(form, MarkovFunctions)
    s = points(given.features[0][:, 0])
    f, slope = form.evaluate(s)
    expected = summed(given, s)
    torch.testing.assert_close(f[:, 0], expected, rtol=0, atol=1e-12 * float(expected.abs().max()))
