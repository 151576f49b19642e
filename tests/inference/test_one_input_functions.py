"""Latents of one input in pieces, against sums of kernel functions."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from tests.inference.problems import normal, rows_of_call

from forcegp.codegen.library import NOT_FINITE
from forcegp.forces.kernels import kernel_of
from forcegp.inference import ExactPosterior, LatentKernels, Terms
from forcegp.inference.one_input import OneInputCall, one_input_form, value_and_slope
from forcegp.inference.pathwise import draw_functions
from forcegp.inference.posterior import LatentPosterior
from forcegp.inference.prepared_kernels import kernel_sums

EXACT = [
    "friction", "matern-1/2", "matern-3/2", "matern-5/2", "linear", "constant",
    "friction + matern-3/2 + matern-1/2 + constant",
]  # fmt: skip


@LatentPosterior.register
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
    return Latents(kernels, (centers[:, None],), (normal(len(centers), seed=8) if weights is None else weights,))


def summed(given, s: torch.Tensor) -> torch.Tensor:
    return given.kernels.dense[0].cross(s[:, None], given.features[0]) @ given.weights[0]


def points(centers: torch.Tensor) -> torch.Tensor:
    """In their range and beyond it, at centres and near zero."""
    return torch.cat([torch.linspace(-3, 3, 61) * centers.abs().max(), centers, torch.tensor([0.0, 1e-9, -1e-9])])


def close(found: torch.Tensor, expected: torch.Tensor, relative: float) -> None:
    torch.testing.assert_close(found, expected, rtol=0.0, atol=relative * float(expected.abs().max()))


CENTERS = {
    "one": (normal(1, seed=3), {}),
    "two": (normal(2, seed=3), {}),
    "thirty": (normal(30, seed=3), {}),
    # x / l is a thousand, whose rounding alone makes 1e-13 of a kernel function, twice
    "short lengths": (normal(30, seed=4), {"scale": 1e-3}),
    "long lengths": (normal(30, seed=4), {"scale": 1e3}),
    "weights that cancel": (normal(1000, seed=5), {"weights": 100.0 * normal(1000, seed=6)}),
    "repeated": (torch.tensor([0.5, -1.0, 0.5, 0.5, 0.0, 0.0], dtype=torch.float64), {}),
}


@pytest.mark.parametrize("centers", CENTERS)
@pytest.mark.parametrize("expression", EXACT)
def test_exact_forms_are_the_sums_everywhere(expression, centers):
    """At centres and far from them, where everything has decayed."""
    at, how = CENTERS[centers]
    given = latents(expression, at, **how)
    form = one_input_form(given, 0)
    assert len(form.knots) <= len(at.unique())
    for s in (points(at[:100]), torch.tensor([-1e3, 1e3], dtype=torch.float64)):
        close(form.values(s)[:, 0], summed(given, s), 1e-12)


def test_several_functions_are_prepared_at_once():
    """The roots of a compressed covariance: the same centres, one column of coefficients for each."""
    given, coefficients = latents("friction", normal(20, seed=7)), normal(20, 3, seed=9)
    form, s = one_input_form(given, 0, coefficients), points(given.features[0][:, 0])
    close(form.values(s), given.kernels.dense[0].cross(s[:, None], given.features[0]) @ coefficients, 1e-12)
    torch.testing.assert_close(form.only(1).values(s)[:, 0], form.values(s)[:, 1], rtol=0, atol=1e-13)


@pytest.mark.parametrize("expression", EXACT)
def test_slopes_are_those_of_the_sums(expression):
    given = latents(expression, normal(30, seed=3))
    form = one_input_form(given, 0)
    s = torch.linspace(-2, 2, 101, dtype=torch.float64)  # no centres: kinks have no slope
    close(value_and_slope(form.values, s)[1], value_and_slope(lambda s: summed(given, s)[:, None], s)[1], 1e-11)


def test_what_has_no_form():
    """Several inputs, and what is smooth."""
    several = Latents(LatentKernels([kernel_of("matern-3/2", 2, 1.0)]), (normal(5, 2),), (normal(5),))
    assert one_input_form(several, 0) is None
    assert one_input_form(several, 0, functions=draw_functions(posterior("matern-3/2", 2), 2, seed=0)) is None
    assert one_input_form(latents("squared-exponential", normal(5)), 0) is None
    smooth = posterior("matern-5/2")
    assert one_input_form(smooth, 0, functions=draw_functions(smooth, 2, seed=0)) is None


def posterior(expression: str, dimension: int = 1) -> ExactPosterior:
    kernels = LatentKernels([kernel_of(expression, dimension, 1.0)])
    kernels.requires_grad_(False)
    W, noise = torch.ones(12, 1, 1, dtype=torch.float64), torch.full((12, 1), 0.01, dtype=torch.float64)
    return ExactPosterior.condition(kernels, Terms([normal(12, dimension, seed=2)], W, normal(12, 1, seed=1), noise))


@pytest.mark.parametrize("expression", ["friction", "linear + friction", "matern-1/2 + constant"])
def test_drawn_functions_of_rough_kernels_are_exact(expression):
    """The cosines of a Matern 1/2 have any frequency, and no table could hold them."""
    latent = posterior(expression)
    drawn = draw_functions(latent, 3, seed=5, widening=1.5)
    form = one_input_form(latent, 0, functions=drawn)
    s = torch.cat([latent.features[0][:, 0], torch.linspace(-90, 90, 2001, dtype=torch.float64)])
    close(form.values(s), drawn([s[:, None].expand(3, -1, -1)])[..., 0].mT, 1e-11)
    nothing = torch.zeros(12, 3, dtype=torch.float64)
    assert (form.values(s) - one_input_form(latent, 0, nothing).values(s)).abs().max() > 0.1


def test_one_source_serves_all_functions_of_a_structure():
    forms = [one_input_form(latents("friction", normal(count, seed=count)), 0) for count in (3, 9)]
    assert forms[0].c_source("f") == forms[1].c_source("f")
    assert all(np.isfinite(form.table()).all() for form in forms)


@pytest.mark.parametrize("lanes", [1, 8])
@pytest.mark.parametrize("expression", [EXACT[-1], "friction", "linear", "constant"])
def test_the_c_code_computes_the_same(expression, lanes, tmp_path):
    given = latents(expression, normal(30, seed=3))
    form = one_input_form(given, 0)
    function = rows_of_call(OneInputCall.in_pieces(kernel_sums(given)[0], form), lanes, tmp_path)
    s = torch.cat([torch.linspace(-1.2, 1.2, 170) * float(form.knots.abs().max()), form.knots[:16], torch.zeros(5)])
    outputs = [torch.empty(len(s), size, dtype=torch.float64) for size in function.outputs]
    assert function.rows([s.double()[:, None]], outputs) == 0
    for found, expected in zip(outputs, value_and_slope(form.values, s.double()), strict=False):
        close(found, expected, 1e-13)
    assert function.single(torch.tensor([math.nan]).double())[0] & NOT_FINITE
