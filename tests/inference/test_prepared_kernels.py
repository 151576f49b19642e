"""Sums of kernel functions as C against the posterior that they were made of."""

import pytest
import torch
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from tests.inference.problems import normal, problem, rows_of_call

from forcegp.inference import ExactPosterior, LatentKernels, Terms, prepared_kernels
from forcegp.inference.prepared_kernels import Sample, compress, kernel_groups, kernel_sums

SHARED = [1, 3, 4]  # latents with the same centres; one of them has one length scale for all features


@pytest.fixture(scope="module")
def latent() -> ExactPosterior:
    given = problem(count=9)
    kernels = list(given.kernels)
    kernels[2] = ScaleKernel(MaternKernel(nu=2.5, ard_num_dims=3)).double()
    kernels[4] = ScaleKernel(RBFKernel()).double()
    features = [given.features[1] + 5.0 if c in SHARED else z for c, z in enumerate(given.features)]
    built = LatentKernels(kernels)
    built.requires_grad_(False)
    return ExactPosterior.condition(built, Terms(features, *given.data))


def close(actual: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(actual, expected, rtol=1e-10, atol=1e-10)


def test_latents_are_grouped_by_their_centers(latent):
    assert kernel_groups(latent) == ((2,), (0,), tuple(SHARED))


@pytest.mark.parametrize("lanes", [1, 8])
def test_the_sums_as_c_have_values_slopes_and_roots(latent, lanes, tmp_path):
    """Every group in a program of its own, whose inputs are the features."""
    one = 5.0 + normal(11, 3, seed=70)
    z = [one if c in SHARED else normal(11, 3, seed=71 + c) for c in range(5)]
    for group, part in zip(kernel_groups(latent), kernel_sums(latent), strict=True):
        function, given = rows_of_call(part, lanes, tmp_path), z[group[0]]
        outputs = [torch.empty(11, size, dtype=torch.float64) for size in function.outputs]
        assert function.rows([given], outputs) == 0
        leaf = [x.clone().requires_grad_() for x in z]
        expected = latent.mean(leaf)[:, list(group)]
        close(outputs[0], expected)
        close(function.single(given[3])[1][0], expected[3])
        for place in range(len(group)):
            theirs = torch.autograd.grad(expected[:, place].sum(), leaf, retain_graph=True, allow_unused=True)
            mine = theirs[group[place]]
            close(outputs[1].view(11, len(group), -1)[:, place], mine)
            close(function.single(given[3])[1][1].view(len(group), -1)[place], mine[3])
        close(outputs[2], torch.stack([latent.kernels.dense[c].diagonal(given) for c in group], -1))


@pytest.fixture(scope="module")
def compressible() -> ExactPosterior:
    given = problem(count=10)
    given.kernels.requires_grad_(False)
    return ExactPosterior.condition(given.kernels, given.terms)


def sample(count: int, seed: int) -> Sample:
    return Sample([normal(count, 3, seed=seed + c) for c in range(5)], normal(count, 2, 5, seed=seed + 9))


def deviations(matrix: torch.Tensor, at: Sample) -> torch.Tensor:
    return torch.einsum("nkc,ncd,nkd->nk", at.W, matrix, at.W).sqrt()


def test_all_combinations_give_the_exact_covariance(compressible):
    at = sample(30, seed=50)  # 60 directions, more than there are data
    compressed = compress(compressible, at, sample(4, seed=90), tolerance=0.0, largest=1000)
    assert compressed.rank == 10 * 4  # H has rank 4
    new = sample(6, seed=200).features
    torch.testing.assert_close(compressed.at(compressible, new), compressible.covariance(new), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("tolerance", [0.3, 0.1, 0.03])
def test_it_is_the_smallest_rank_of_the_tolerance_and_never_below_the_exact_covariance(compressible, tolerance):
    chosen_at, checked_at = sample(20, seed=50), sample(7, seed=90)
    compressed = compress(compressible, chosen_at, checked_at, tolerance=tolerance, largest=1000)
    assert 1 < compressed.rank < 40
    at_check, exact = compressed.at(compressible, checked_at.features), compressible.covariance(checked_at.features)
    assert float(torch.linalg.eigvalsh(at_check - exact).min()) > -1e-9
    inflation = deviations(at_check, checked_at) / deviations(exact, checked_at) - 1.0
    torch.testing.assert_close(compressed.inflation, inflation.flatten(), rtol=0.0, atol=1e-7)
    assert float(inflation.max()) <= tolerance
    smaller = compress(compressible, chosen_at, checked_at, tolerance=tolerance, largest=compressed.rank - 1)
    assert smaller.rank == compressed.rank - 1
    assert float(smaller.inflation.max()) > tolerance


def test_blocks_of_states_change_nothing(compressible, monkeypatch):
    whole = compress(compressible, sample(9, seed=50), sample(7, seed=90), tolerance=0.0, largest=12)
    monkeypatch.setattr(prepared_kernels, "BLOCK_BYTES", 8 * 10 * 5 * 5 * 4)  # four states
    blocks = compress(compressible, sample(9, seed=50), sample(7, seed=90), tolerance=0.0, largest=12)
    torch.testing.assert_close(blocks.inflation, whole.inflation, rtol=1e-7, atol=1e-9)
    monkeypatch.setattr(prepared_kernels, "BLOCK_BYTES", 1)  # less than a state needs
    assert compress(compressible, sample(3, seed=50), sample(2, seed=90), tolerance=0.0, largest=3).rank == 3


def test_directions_without_variance_do_not_count(compressible):
    at = sample(9, seed=50)
    blind = Sample(at.features, torch.cat([at.W, torch.zeros_like(at.W)], dim=1))
    compressed = compress(compressible, at, blind, tolerance=0.05, largest=12)
    assert torch.isfinite(compressed.inflation).all()
    assert len(compressed.inflation) == 18
