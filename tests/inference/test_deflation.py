"""Deflation is a change of variables: nothing may depend on the basis, and nothing may get lost."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.inference.problems import normal, problem

from forcegp.inference.likelihood import DeflatedSystem, Deflation, deflate, solve_deflated, whiten

seeds = st.integers(0, 10_000)


def quadratic_and_log_determinant(system: DeflatedSystem) -> torch.Tensor:
    quadratic = (system.deflation.t * system.alpha).sum() + system.deflation.remainder.square().sum()
    return torch.stack([quadratic, system.factor.log_determinant()])


@settings(max_examples=50)
@given(shape=st.tuples(st.integers(1, 6), st.integers(1, 5), st.integers(1, 6)), seed=seeds)
def test_it_is_exact_and_orthonormal(shape, seed):
    count, outputs, latents = shape
    W, y = normal(*shape, seed=seed), normal(count, outputs, seed=seed + 1)
    deflation = deflate(W, y)
    U = deflation.U
    assert deflation.rank == min(outputs, latents)
    identity = torch.eye(deflation.rank, dtype=torch.float64).expand(count, -1, -1)
    torch.testing.assert_close(U.mT @ U, identity, rtol=0.0, atol=1e-13)
    torch.testing.assert_close(U @ deflation.C, W, rtol=0.0, atol=1e-13)
    torch.testing.assert_close((U @ deflation.t[..., None])[..., 0] + deflation.remainder, y, rtol=0.0, atol=1e-13)
    assert float((U.mT @ deflation.remainder[..., None]).abs().max()) < 1e-13


@settings(max_examples=30)
@given(seed=seeds)
def test_any_other_basis_gives_the_same(seed):
    given_problem = problem(count=5, outputs=4, constraints=1, seed=seed)
    W_white, y_white, _ = whiten(*given_problem.data)
    with torch.no_grad():
        deflation, matrices = deflate(W_white, y_white), given_problem.kernels(given_problem.features)
        Q = torch.linalg.qr(normal(5, deflation.rank, deflation.rank, seed=seed)).Q
        t = (Q @ deflation.t[..., None])[..., 0]
        turned = Deflation(deflation.U @ Q.mT, Q @ deflation.C, t, deflation.remainder)
        here, there = (solve_deflated(basis, matrices) for basis in (deflation, turned))
        torch.testing.assert_close(quadratic_and_log_determinant(here), quadratic_and_log_determinant(there))
        torch.testing.assert_close(here.beta, there.beta, rtol=1e-9, atol=1e-9)


def test_nothing_to_deflate():
    deflation = deflate(torch.zeros(4, 3, 2, dtype=torch.float64), normal(4, 3))
    assert deflation.rank == 0
    assert torch.equal(deflation.remainder, normal(4, 3))
    assert deflate(torch.zeros(0, 3, 2, dtype=torch.float64), normal(0, 3)).U.shape[0] == 0
