"""Drawn functions against the exact posterior."""

import numpy as np
import pytest
import torch
from gpytorch.kernels import CosineKernel, LinearKernel, RBFKernel, ScaleKernel
from tests.inference.kernel_functions import kernel_cross, kernel_matrix
from tests.inference.problems import normal

from forcegp.errors import InvalidInput
from forcegp.forces.kernels import kernel_of
from forcegp.inference import ExactPosterior, LatentKernels, Terms
from forcegp.inference.pathwise import DrawnTerm, draw_functions, kernel_terms

POINTS, OUTPUTS = 9, 3


def conditioned(kernels: list, dimensions: tuple[int, ...]) -> ExactPosterior:
    """A posterior from random numbers; W has rank 2 of 3 at every point, as with one contact."""
    generator = torch.Generator().manual_seed(0)
    features = [torch.randn(POINTS, d, dtype=torch.float64, generator=generator) for d in dimensions]
    W = torch.randn(POINTS, OUTPUTS, len(dimensions), dtype=torch.float64, generator=generator)
    hidden = torch.randn(POINTS, OUTPUTS, 1, dtype=torch.float64, generator=generator)
    hidden = hidden / hidden.norm(dim=1, keepdim=True)
    W, residual = W - hidden @ hidden.mT @ W, torch.randn(POINTS, OUTPUTS, dtype=torch.float64, generator=generator)
    noise = torch.full((1, OUTPUTS), 0.09, dtype=torch.float64)
    latent = LatentKernels([kernel.double() for kernel in kernels])
    return ExactPosterior.condition(latent.at(latent.initial_parameters()), Terms(features, W, residual, noise))


def scaled_rbf(dimension: int, lengthscale: float, variance: float) -> ScaleKernel:
    kernel = ScaleKernel(RBFKernel(ard_num_dims=dimension))
    kernel.base_kernel.lengthscale = lengthscale * torch.linspace(0.8, 1.3, dimension)
    kernel.outputscale = variance
    return kernel


@pytest.mark.parametrize(
    "kernel",
    [ScaleKernel(CosineKernel()), LinearKernel() * CosineKernel(), ScaleKernel(RBFKernel(active_dims=(0,)))],
    ids=["no spectrum", "a part of a product", "some features"],
)
def test_kernels_that_cannot_be_drawn_are_named(kernel):
    latent = conditioned([kernel, scaled_rbf(1, 0.9, 1.4)], (1, 1))
    with pytest.raises(InvalidInput, match=r"CosineKernel|ScaleKernel with active"):
        draw_functions(latent, 2, seed=0)


COMPOSED = {"squared-exponential": 3, "friction": 1, "linear + matern-3/2": 3, "constant + squared-exponential": 2}


@pytest.mark.parametrize("expression", COMPOSED)
def test_functions_have_mean_and_covariance_of_the_posterior(expression):
    """At single points with all latents, and of the first latent across points."""
    dimension, count = COMPOSED[expression], 6000
    kernels = [kernel_of(expression, dimension, 1.3), kernel_of("squared-exponential", 1, 0.8)]
    latent, points = conditioned(kernels, (dimension, 1)), [normal(5, d, seed=5) for d in (dimension, 1)]
    for z, training in zip(points, latent.features, strict=True):
        z[3], z[4] = 30.0, training[2]  # far away, and where data are
    functions = draw_functions(latent, count, seed=3, frequencies=16)
    values = functions([z.expand(count, -1, -1) for z in points])  # S n C
    mean, covariance = latent.mean(points), latent.covariance(points)
    std = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((values.mean(0) - mean).abs() <= 4.5 * std / count**0.5).all()
    unspread = draw_functions(latent, 2, seed=3, frequencies=16, widening=0.0)
    torch.testing.assert_close(unspread([z.expand(2, -1, -1) for z in points])[0], mean)
    for n in range(5):
        scale = std[n][:, None] * std[n][None, :]
        assert ((torch.cov(values[:, n].mT) - covariance[n]).abs() <= 7.0 * scale / count**0.5).all()
    kernel, C = next(iter(latent.kernels)), latent.system.deflation.C[..., 0]
    V = (kernel_cross(kernel, points[0], latent.features[0])[:, :, None] * C[None]).reshape(5, -1)
    exact = kernel_matrix(kernel, points[0]) - V @ latent.system.factor.solve(V.mT.contiguous())
    scale = std[:, :1] * std[:, 0][None, :]
    assert ((torch.cov(values[..., 0].mT) - exact).abs() <= 7.0 * scale / count**0.5).all()


def test_a_function_answers_alike_whenever_and_with_whatever_else_it_is_asked():
    latent = conditioned([kernel_of("friction", 1, 1.3), kernel_of("linear + matern-5/2", 3, 0.8)], (1, 3))
    points = [torch.randn(4, 5, d, dtype=torch.float64, generator=torch.Generator().manual_seed(d)) for d in (1, 3)]
    functions = draw_functions(latent, 4, seed=2)
    together = functions(points)
    torch.testing.assert_close(together[:, 2:3], functions([z[:, 2:3] for z in points]), rtol=0, atol=1e-12)
    torch.testing.assert_close(draw_functions(latent, 4, seed=2)(points), together, rtol=0, atol=0)
    assert (draw_functions(latent, 4, seed=3)(points) - together).abs().max() > 1e-3
    rest = functions([torch.zeros(4, 1, 1, dtype=torch.float64), points[1][:, :1]])
    assert float(rest[..., 0].abs().max()) == 0.0  # no friction at rest, in any function


def test_drawing_leaves_the_global_random_states_alone():
    latent = conditioned([kernel_of("matern-5/2", 3, 0.8)], (3,))
    before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002  # that one is meant
    draw_functions(latent, 2, seed=0)
    assert torch.equal(torch.get_rng_state(), before)
    assert (np.random.get_state()[1] == numpy_before).all()  # noqa: NPY002


def test_a_drawn_function_is_a_cosine_and_a_sine_of_its_own_weight():
    kernel = ScaleKernel(RBFKernel()).double()
    kernel.outputscale, kernel.base_kernel.lengthscale = 4.0, 0.5
    kernel.requires_grad_(False)
    (term,) = kernel_terms(kernel)
    a, b, omega = (torch.tensor(numbers, dtype=torch.float64).reshape(1, 1, 2) for numbers in ([1, 2], [3, -1], [2, 5]))
    z = torch.linspace(-1.0, 1.0, 6, dtype=torch.float64)[:, None]
    phase = z * omega[0] / 0.5
    expected = 2.0 * (phase.cos() * a[0] + phase.sin() * b[0]).sum(-1)  # sqrt(s) = 2
    torch.testing.assert_close(DrawnTerm(term, (omega,), (a, b))(z), expected[None], rtol=1e-13, atol=1e-13)
