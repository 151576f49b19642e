"""The deflated likelihood and every gradient of it against the dense covariance and autograd."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.inference.dense import dense_covariance, dense_negative_log_likelihood, precise_value_and_gradients
from tests.inference.problems import SHAPES, Problem, constrained_inverse_mass, normal, problem

from forcegp.errors import NumericalError
from forcegp.inference import likelihood, negative_log_likelihood

ABSOLUTE, RELATIVE = 1e-6, 1e-7

PANELS = ("one panel", "some panels", "one row per panel")


def assert_same_value_and_gradients(given_problem: Problem, noise_of=lambda problem: (problem.noise, [problem.noise])):
    """Compare with the dense oracle with respect to residual, noise, features and kernel parameters."""
    data = {"residual": given_problem.residual}
    for tensor in (*data.values(), given_problem.noise, *given_problem.features):
        tensor.requires_grad_()
    noise, noise_leaves = noise_of(given_problem)
    data |= {f"noise {k}": leaf for k, leaf in enumerate(noise_leaves)}
    data |= {f"features {c}": z for c, z in enumerate(given_problem.features)}
    data |= dict(given_problem.kernels.named_parameters())
    arguments = given_problem.W, given_problem.residual, noise
    each = zip(given_problem.kernels.kernels, given_problem.features, strict=True)
    dense = [kernel(z, z).to_dense() for kernel, z in each]  # GPyTorch itself, under plain autograd
    expected = dense_negative_log_likelihood(*arguments, dense)
    result = negative_log_likelihood(*arguments, given_problem.kernels(given_problem.features))
    assert abs(float((result - expected).detach())) < ABSOLUTE
    gradients, expected_gradients = (
        torch.autograd.grad(-2.5 * value, list(data.values()), retain_graph=True) for value in (result, expected)
    )
    for name, gradient, reference in zip(data, gradients, expected_gradients, strict=True):
        assert float((gradient - reference).abs().max()) <= RELATIVE * max(1.0, float(reference.abs().max())), name


@pytest.mark.parametrize(("panel_bytes", "inner"), [(4 * 2**20, 256), (5000, 7), (1, 1)], ids=PANELS)
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_value_and_all_gradients_with_noise_variances(shape, panel_bytes, inner, monkeypatch):
    monkeypatch.setattr(likelihood, "PANEL_BYTES", panel_bytes)
    monkeypatch.setattr(likelihood, "INNER", inner)
    given_problem = problem(**shape)
    given_problem.W[0] *= 0.0  # a point of lower rank than the others
    assert_same_value_and_gradients(given_problem)


def test_latents_that_act_on_an_output_each_are_as_many_small_problems(monkeypatch):
    sizes, whiten = [], likelihood.whiten
    monkeypatch.setattr(likelihood, "whiten", lambda W, *rest: sizes.append(tuple(W.shape)) or whiten(W, *rest))
    given_problem = problem(outputs=3, latents=3, constraints=0)
    given_problem.W = torch.diag_embed(given_problem.W.diagonal(dim1=-2, dim2=-1))
    assert_same_value_and_gradients(given_problem)
    assert sizes == [(12, 1, 1)] * 3


@pytest.mark.parametrize("shared", [False, True], ids=["one per point", "shared"])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_noise_covariances(shape, shared):
    given_problem = problem(**shape)
    count, outputs = given_problem.residual.shape
    factor = 0.3 * normal(1 if shared else count, outputs, outputs, seed=7)
    given_problem.noise = factor @ factor.mT + 0.05 * torch.eye(outputs, dtype=torch.float64)

    def symmetric(p):  # a factorisation reads one triangle: gradients in single entries are a convention
        return 0.5 * (p.noise + p.noise.mT), [p.noise]

    assert_same_value_and_gradients(given_problem, symmetric)


@pytest.mark.parametrize("constraints", [0, 1, 3])
def test_force_level_noise(constraints, monkeypatch):
    """R_i = diag(sigma^2) + H_i diag(sigma_F^2) H_i^T with H_i = W_i."""
    monkeypatch.setattr(likelihood, "PANEL_BYTES", 5000)
    given_problem = problem(constraints=constraints)
    given_problem.noise = given_problem.noise[:1].clone()
    log_force = 0.3 * normal(5, seed=9)

    def force_noise(p):
        log_force.requires_grad_()
        return torch.diag_embed(p.noise) + ((p.W * (2.0 * log_force).exp()) @ p.W.mT), [p.noise, log_force]

    assert_same_value_and_gradients(given_problem, force_noise)


def test_points_of_differing_rank():
    """Free, held, held twice, fully blocked: ranks 4, 3, 2 and 0, in any order."""
    given_problem = problem(count=8, outputs=4, constraints=0)
    for row, constraints in ((0, 3), (2, 1), (3, 4), (5, 2), (7, 1)):
        if constraints == 4:
            given_problem.W[row] = 0.0
        else:
            given_problem.W[row] = constrained_inverse_mass(1, 4, constraints, seed=row)[0]
    assert_same_value_and_gradients(given_problem)


def test_an_arm_with_a_light_wrist_keeps_its_precision():
    """H_77 ~ 1000 at noise 0.01, as on the iiwa, makes the dense covariance lose digits: 40 digits are the oracle."""
    given_problem = problem(count=5, outputs=3, constraints=1)
    scale = torch.tensor([1.0, 5.0, 40.0], dtype=torch.float64)
    given_problem.W = scale[:, None] * given_problem.W * scale
    given_problem.residual = given_problem.residual * scale
    given_problem.noise = torch.full((1, 3), 0.01, dtype=torch.float64)
    matrices = [K.detach().requires_grad_() for K in given_problem.kernels(given_problem.features)]
    assert torch.linalg.cond(dense_covariance(given_problem.W, given_problem.noise, matrices).detach()) > 1e8
    expected, expected_gradients = precise_value_and_gradients(*given_problem.data, matrices)
    leaves = [given_problem.residual.requires_grad_(), given_problem.noise.requires_grad_(), *matrices]
    value = negative_log_likelihood(*given_problem.data, matrices)
    assert float(value.detach()) == pytest.approx(expected, rel=1e-12)
    for gradient, reference in zip(torch.autograd.grad(value, leaves), expected_gradients[1:], strict=True):
        torch.testing.assert_close(gradient, reference, rtol=0.0, atol=1e-10 * float(reference.abs().max()))


def test_second_derivatives_are_refused_and_never_silently_wrong():
    given_problem = problem(count=4, outputs=2, constraints=0)
    noise = given_problem.noise.requires_grad_()
    value = negative_log_likelihood(*given_problem.data, given_problem.kernels(given_problem.features))
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        torch.autograd.grad(value, noise, create_graph=True)


def test_a_system_that_cannot_move_is_pure_noise():
    given_problem = problem(count=6, outputs=3)
    given_problem.W = torch.zeros_like(given_problem.W)
    assert_same_value_and_gradients(given_problem)


# ---------------------------------------------------------------- what it refuses


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_values_that_are_not_finite_are_named_by_row(value):
    for name, message in (("W", "mixing vectors W of row 3"), ("residual", "residuals y - m of row 3")):
        given_problem = problem(count=6, outputs=3)
        getattr(given_problem, name)[3, 1] = value
        with pytest.raises(NumericalError, match=message):
            negative_log_likelihood(*given_problem.data, given_problem.kernels(given_problem.features))


@pytest.mark.parametrize("covariances", [False, True])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_noise_must_be_positive(covariances, value):
    given_problem, place = problem(count=6, outputs=3), (4, 1, 1) if covariances else (4, 1)
    noise = torch.diag_embed(given_problem.noise) if covariances else given_problem.noise
    noise[place] = value
    given_problem.noise = noise.requires_grad_()
    with pytest.raises(NumericalError, match="covariance of row 4" if covariances else "variances must be positive"):
        negative_log_likelihood(*given_problem.data, given_problem.kernels(given_problem.features))


@pytest.mark.parametrize("where", [(2, 2), (4, 1)], ids=["diagonal", "beside it"])
def test_kernel_matrices_must_be_finite(where):
    given_problem = problem(count=6, outputs=3)
    matrices = [K.detach().clone() for K in given_problem.kernels(given_problem.features)]
    matrices[1][where] = math.nan
    matrices[1][where[::-1]] = math.nan
    with pytest.raises(NumericalError, match="covariance matrix"):
        negative_log_likelihood(*given_problem.data, matrices)


# ---------------------------------------------------------------- properties


@settings(max_examples=40)
@given(count=st.integers(1, 6), outputs=st.integers(1, 4), latents=st.integers(1, 5), seed=st.integers(0, 10_000))
def test_any_problem_has_the_value_and_gradients_of_the_dense_one(**shape):
    assert_same_value_and_gradients(problem(constraints=0, **shape))
