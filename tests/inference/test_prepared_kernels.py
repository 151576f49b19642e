"""Prepared kernel functions against the posterior that they were prepared from."""

import pytest
import torch
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from tests.inference.problems import normal, problem

from forcegp.inference import ExactPosterior, LatentKernels
from forcegp.inference.prepared_kernels import PreparedKernels, SharedCenters

SHARED = [1, 3, 4]
"""Latents with the same centres; one of them has one length scale for all features."""


@pytest.fixture(scope="module")
def latent() -> ExactPosterior:
    given = problem(count=9)
    kernels = list(given.kernels)
    kernels[2] = ScaleKernel(MaternKernel(nu=2.5, ard_num_dims=3)).double()
    kernels[4] = ScaleKernel(RBFKernel()).double()
    features = [given.features[1] + 5.0 if c in SHARED else z for c, z in enumerate(given.features)]
    built = LatentKernels(kernels)
    built.requires_grad_(False)
    return ExactPosterior.condition(built, features, *given.data)


@pytest.fixture(scope="module", params=[False, True], ids=["torch", "compiled"])
def prepared(request, latent) -> PreparedKernels:
    return PreparedKernels.of(latent, request.param)


def points(latent: ExactPosterior, count: int = 6) -> list[torch.Tensor]:
    one = 5.0 + normal(count, 3, seed=70)
    return [one if c in SHARED else normal(count, 3, seed=71 + c) for c in range(5)]


def close(actual: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(actual, expected, rtol=1e-10, atol=1e-10)


def test_latents_are_grouped_by_their_centers(prepared):
    assert [group.latents for group in prepared.groups if isinstance(group, SharedCenters)] == [(0,), tuple(SHARED)]
    assert [group.latents for group in prepared.groups if not isinstance(group, SharedCenters)] == [(2,)]


def test_means_and_kernel_functions(latent, prepared):
    z = points(latent)
    mean, cross = prepared.mean(prepared.inputs(z), keep=True)
    close(mean, latent.mean(z))
    for group, found in zip(prepared.groups, cross, strict=True):
        for place, c in enumerate(group.latents):
            close(found[:, place], latent.kernels.dense[c].cross(z[c], latent.features[c]))
    close(
        prepared.diagonal(prepared.inputs(z)),
        torch.stack([k.diagonal(x) for k, x in zip(latent.kernels.dense, z, strict=True)], dim=-1),
    )


def test_slopes_are_derivatives_of_the_mean(latent, prepared):
    """In two numbers x of which all features are affine functions."""
    directions = [normal(3, 2, seed=90) if c in SHARED else normal(3, 2, seed=91 + c) for c in range(5)]
    base = points(latent)

    def inputs(x):
        return prepared.inputs([z + x @ D.mT for z, D in zip(base, directions, strict=True)])

    x = 0.3 * normal(6, 2, seed=99)
    jacobians = torch.autograd.functional.jacobian(lambda y: tuple(inputs(y)), x)  # rows do not meet
    slopes = [torch.einsum("nane->nae", part) for part in jacobians]
    mean, found = prepared.mean_and_slopes(inputs(x), slopes)
    close(mean, latent.mean([z + x @ D.mT for z, D in zip(base, directions, strict=True)]))
    expected = torch.autograd.functional.jacobian(lambda y: prepared.mean(inputs(y))[0], x)
    close(found, torch.einsum("ncne->nce", expected))
