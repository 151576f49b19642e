"""The methods that `benchmarks.solvers` compares solve the same system, and its estimated gradients are unbiased."""

import pytest
import torch
from benchmarks.gradient_probes import estimated_gradient, exact_gradient
from benchmarks.rival_solvers import small_problem_solvers
from benchmarks.solver_problem import Problem

from forcegp.inference import LatentKernels, Terms, negative_log_likelihood
from forcegp.models import MarginalLikelihood
from forcegp.priors.kernels import squared_exponential_kernel


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.fixture(scope="module")
def problem():
    z = normal(30, 3)
    kernels = LatentKernels([squared_exponential_kernel(3, 1.5, 1.0 + c) for c in range(3)]).requires_grad_(False)
    return Problem(kernels, (z, z, z), normal(30, 2, 3, seed=1), normal(30, 2, seed=2))


@pytest.mark.parametrize("name", small_problem_solvers())
def test_every_method_solves_the_dense_system(problem, name):
    T = torch.einsum("iac,cij,jbc->iajb", problem.C, problem.matrices, problem.C).reshape(60, 60)
    expected = torch.linalg.solve(T + torch.eye(60, dtype=T.dtype), problem.t.reshape(-1)).view_as(problem.t)
    alpha, residual = problem.t, None
    for _, (alpha, residual) in zip(range(1000), small_problem_solvers()[name](problem), strict=False):  # noqa: B007
        if problem.relative_residual(alpha) < 1e-8:
            break
    torch.testing.assert_close(alpha, expected, rtol=0.0, atol=1e-6)
    if residual is not None:
        torch.testing.assert_close(residual, problem.t - problem.product(alpha), rtol=0.0, atol=1e-6)


class Likelihood(MarginalLikelihood):
    """What `gradient_probes` needs of a likelihood, with data of its own."""

    def __init__(self):
        pass

    def terms(self, parameters):
        z = normal(25, 2)
        noise = (2.0 * parameters["noise"]).exp()[None]
        return Terms([z, z, z], normal(25, 4, 3, seed=1), normal(25, 4, seed=2), noise)

    def __call__(self, kernels, parameters):
        features, W, residual, noise = self.terms(parameters)
        return negative_log_likelihood(W, residual, noise, kernels.matrices(parameters, features))


def test_estimated_gradients_approach_the_exact_one():
    likelihood = Likelihood()
    kernels = LatentKernels([squared_exponential_kernel(2, 1.5, 1.0 + c) for c in range(3)])
    parameters = {**kernels.initial_parameters(), "noise": torch.full((4,), -1.0, dtype=torch.float64)}
    exact = torch.cat([part.reshape(-1) for part in exact_gradient(likelihood, kernels, parameters)])

    def error(probes):
        found = estimated_gradient(likelihood, kernels, parameters, probes=probes, points=25, seed=0, tolerance=1e-10)
        return float((torch.cat([part.reshape(-1) for part in found]) - exact).norm() / exact.norm())

    many = error(2000)
    assert many < 0.05
    assert many < 0.5 * error(20)
