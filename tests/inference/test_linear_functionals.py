"""Likelihood and posterior from linear functionals against one dense operator on the covariance of all states."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.inference.dense import dense_covariance
from tests.inference.problems import Problem, normal, problem

from forcegp.errors import InvalidInput, NotEnoughMemory
from forcegp.inference import ExactPosterior, FunctionalPosterior, Terms, exact, memory, negative_log_likelihood
from forcegp.inference.linear_functionals import functional_negative_log_likelihood, require_memory_for_functionals
from forcegp.inference.pathwise import draw_functions

SHAPES = {
    "no constraint": {"constraints": 0},
    "one constraint": {"constraints": 1},
    "more latents than outputs": {"latents": 6, "outputs": 3},
    "one latent": {"latents": 1},
    "one output": {"outputs": 1, "constraints": 0},
}
NODES = 3


def terms_of(given_problem: Problem) -> Terms:
    return Terms(given_problem.features, given_problem.W, given_problem.residual, given_problem.noise)


def window_weights(given_problem: Problem, nodes: int = NODES) -> torch.Tensor:
    weights = 0.2 + normal(len(given_problem.W) // nodes, nodes, seed=5).abs()
    return weights / weights.sum(-1, keepdim=True)


def dense_parts(weights, terms: Terms, matrices) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Covariance of all states, the operator that makes functionals of them, and the covariance of their noise."""
    states, outputs, _ = terms.W.shape
    count, nodes = weights.shape
    clean = dense_covariance(terms.W, torch.zeros(1, outputs, dtype=torch.float64), matrices)
    operator = torch.zeros(count, outputs, states, outputs, dtype=torch.float64)
    noise = torch.zeros(count, outputs, count, outputs, dtype=torch.float64)
    R = torch.diag_embed(terms.noise) if terms.noise.dim() == 2 else terms.noise
    R = R.expand(states, outputs, outputs)
    for w in range(count):
        total = weights[w].square().sum()
        for i in range(nodes):
            row = w * nodes + i
            operator[w, :, row, :] = weights[w, i] * torch.eye(outputs, dtype=torch.float64)
            noise[w, :, w, :] += weights[w, i] ** 2 / total * R[row]
    rows = count * outputs
    return clean, operator.reshape(rows, states * outputs), noise.reshape(rows, rows)


def dense_nll(weights, terms: Terms, matrices) -> torch.Tensor:
    clean, operator, noise = dense_parts(weights, terms, matrices)
    S, y = operator @ clean @ operator.mT + noise, operator @ terms.residual.reshape(-1)
    log_density = torch.distributions.MultivariateNormal(torch.zeros_like(y), 0.5 * (S + S.mT)).log_prob(y)
    return -log_density


@pytest.mark.parametrize("shared", [False, True], ids=["noise of states", "one noise"])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_value_and_all_gradients(shape, shared):
    given_problem = problem(**shape)
    if shared:
        given_problem.noise = given_problem.noise[:1].clone()
    weights, terms = window_weights(given_problem), terms_of(given_problem)
    leaves = [weights, terms.W, terms.residual, terms.noise, *terms.features]
    for leaf in leaves:
        leaf.requires_grad_()
    leaves += list(given_problem.kernels.parameters())
    plain = [k(z, z).to_dense() for k, z in zip(given_problem.kernels.kernels, terms.features, strict=True)]
    expected = dense_nll(weights, terms, plain)
    result = functional_negative_log_likelihood(weights, terms, given_problem.kernels(terms.features))
    torch.testing.assert_close(result, expected, rtol=1e-10, atol=1e-8)
    for ours, reference in zip(torch.autograd.grad(result, leaves), torch.autograd.grad(expected, leaves), strict=True):
        assert float((ours - reference).abs().max()) <= 1e-7 * max(1.0, float(reference.abs().max()))


def test_noise_covariances_that_turn_with_the_state():
    given_problem = problem(constraints=1)
    factor = 0.3 * normal(12, 5, 5, seed=7)
    given_problem.noise = factor @ factor.mT + 0.05 * torch.eye(5, dtype=torch.float64)
    weights, terms = window_weights(given_problem), terms_of(given_problem)
    with torch.no_grad():
        matrices = given_problem.kernels(terms.features)
        result = functional_negative_log_likelihood(weights, terms, matrices)
        torch.testing.assert_close(result, dense_nll(weights, terms, matrices), rtol=1e-10, atol=1e-8)


def test_gradcheck_through_kernel_matrices():
    given_problem = problem(count=4, outputs=2, constraints=0, latents=2)
    weights, terms = window_weights(given_problem, 2), terms_of(given_problem)
    K = [k.detach().requires_grad_() for k in given_problem.kernels(terms.features)]

    def value(W, residual, *matrices):
        symmetric = [0.5 * (matrix + matrix.mT) for matrix in matrices]
        return functional_negative_log_likelihood(weights, terms._replace(W=W, residual=residual), symmetric)

    assert torch.autograd.gradcheck(value, (terms.W.requires_grad_(), terms.residual.requires_grad_(), *K))


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_posterior_is_that_of_dense_conditioning(shape):
    given_problem = problem(**shape)
    weights, terms = window_weights(given_problem), terms_of(given_problem)
    posterior = FunctionalPosterior.condition(given_problem.kernels, weights, terms)
    new = [normal(6, z.shape[1], seed=100 + c) for c, z in enumerate(terms.features)]
    kernels = given_problem.kernels.kernels
    with torch.no_grad():
        matrices = [k(z, z).to_dense() for k, z in zip(kernels, terms.features, strict=True)]
        clean, operator, noise = dense_parts(weights, terms, matrices)
        S = operator @ clean @ operator.mT + noise
        cross = torch.stack([k(a, b).to_dense() for k, a, b in zip(kernels, new, terms.features, strict=True)])
        with_states = torch.einsum("cnj,jdc->ncjd", cross, terms.W).flatten(2)
        with_data = with_states @ operator.mT
        mean = with_data @ torch.linalg.solve(S, operator @ terms.residual.reshape(-1))
        prior = torch.stack([k(z, diag=True) for k, z in zip(kernels, new, strict=True)], dim=-1)
        covariance = torch.diag_embed(prior) - with_data @ torch.linalg.solve(S, with_data.mT)
        torch.testing.assert_close(posterior.mean(new), mean, rtol=1e-8, atol=1e-9)
        torch.testing.assert_close(posterior.covariance(new), covariance, rtol=1e-8, atol=1e-9)
        one_mean, variance = posterior.one(0, new[0])
        torch.testing.assert_close(one_mean, mean[:, 0], rtol=1e-8, atol=1e-9)
        torch.testing.assert_close(variance, covariance[:, 0, 0], rtol=1e-8, atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 4), st.integers(1, 3), st.integers(0, 1), st.integers(0, 5))
def test_one_node_in_each_is_ordinary_inference(count, outputs, constraints, seed):
    given_problem = problem(count=count, outputs=outputs, constraints=min(constraints, outputs - 1), seed=seed)
    terms, ones = terms_of(given_problem), torch.ones(count, 1, dtype=torch.float64)
    with torch.no_grad():
        matrices = given_problem.kernels(terms.features)
        ours = functional_negative_log_likelihood(ones, terms, matrices)
        rows = negative_log_likelihood(terms.W, terms.residual, terms.noise, matrices)
        torch.testing.assert_close(ours, rows, rtol=1e-9, atol=1e-8)
        left = FunctionalPosterior.condition(given_problem.kernels, ones, terms)
        right = ExactPosterior.condition(given_problem.kernels, terms)
        new = [normal(3, z.shape[1], seed=100 + c) for c, z in enumerate(terms.features)]
        torch.testing.assert_close(left.mean(new), right.mean(new), rtol=1e-7, atol=1e-8)
        torch.testing.assert_close(left.covariance(new), right.covariance(new), rtol=1e-7, atol=1e-8)


def test_drawn_functions_have_the_moments_of_the_posterior():
    given_problem = problem(count=9, outputs=2, constraints=0, latents=2)
    posterior = FunctionalPosterior.condition(
        given_problem.kernels, window_weights(given_problem), terms_of(given_problem)
    )
    new = [normal(4, z.shape[1], seed=100 + c) for c, z in enumerate(posterior.features)]
    samples = 4000
    with torch.no_grad():
        values = draw_functions(posterior, samples, seed=0)([z.expand(samples, *z.shape) for z in new])
        mean, covariance = posterior.mean(new), posterior.covariance(new)
    std = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert float(((values.mean(0) - mean).abs() / std).max()) < 5.0 / math.sqrt(samples)
    assert float((values.std(0) / std - 1.0).abs().max()) < 0.08


def test_what_needs_single_rows_says_so():
    given_problem = problem(count=6)
    posterior = FunctionalPosterior.condition(
        given_problem.kernels, window_weights(given_problem), terms_of(given_problem)
    )
    with pytest.raises(InvalidInput, match=r"FunctionalPosterior .*accelerations"):
        exact(posterior, "leaving rows out")


def test_memory_is_that_of_the_kernel_matrices_and_the_covariances(monkeypatch):
    """20 windows of 3 nodes: three matrices of all states and two from states to outputs for each latent, four of S."""
    needed = 8 * (5 * 3 * 60 * 60 + 5 * 2 * 60 * 80 + 4 * 80 * 80)
    weights = torch.ones(20, 3, dtype=torch.float64)
    monkeypatch.setattr(memory, "free_memory", lambda device: math.ceil(needed / memory.USABLE))
    require_memory_for_functionals(weights, outputs=4, latents=5)
    monkeypatch.setattr(memory, "free_memory", lambda device: math.floor(needed / memory.USABLE) - 1)
    with pytest.raises(NotEnoughMemory, match="20 windows of 3 nodes"):
        require_memory_for_functionals(weights, outputs=4, latents=5)
