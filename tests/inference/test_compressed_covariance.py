"""The covariance from few combinations of the data against the exact one of the same posterior."""

import pytest
import torch
from tests.inference.problems import normal, problem

from forcegp.inference import ExactPosterior, prepared_kernels
from forcegp.inference.prepared_kernels import Sample, compress


@pytest.fixture(scope="module")
def latent() -> ExactPosterior:
    given = problem(count=10)
    given.kernels.requires_grad_(False)
    return ExactPosterior.condition(given.kernels, given.terms)


def sample(count: int, seed: int) -> Sample:
    return Sample([normal(count, 3, seed=seed + c) for c in range(5)], normal(count, 2, 5, seed=seed + 9))


def deviations(matrix: torch.Tensor, at: Sample) -> torch.Tensor:
    return torch.einsum("nkc,ncd,nkd->nk", at.W, matrix, at.W).sqrt()


def test_all_combinations_give_the_exact_covariance(latent):
    at = sample(30, seed=50)  # 60 directions, more than there are data
    compressed = compress(latent, at, sample(4, seed=90), tolerance=0.0, largest=1000)
    assert compressed.rank == 10 * 4  # H has rank 4
    new = sample(6, seed=200).features
    torch.testing.assert_close(compressed.at(latent, new), latent.covariance(new), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("tolerance", [0.3, 0.1, 0.03])
def test_it_is_the_smallest_rank_of_the_tolerance_and_never_below_the_exact_covariance(latent, tolerance):
    chosen_at, checked_at = sample(20, seed=50), sample(7, seed=90)
    compressed = compress(latent, chosen_at, checked_at, tolerance=tolerance, largest=1000)
    assert 1 < compressed.rank < 40
    at_check = compressed.at(latent, checked_at.features)
    exact = latent.covariance(checked_at.features)
    assert float(torch.linalg.eigvalsh(at_check - exact).min()) > -1e-9
    inflation = deviations(at_check, checked_at) / deviations(exact, checked_at) - 1.0
    torch.testing.assert_close(compressed.inflation, inflation.flatten(), rtol=0.0, atol=1e-7)
    assert float(inflation.max()) <= tolerance
    smaller = compress(latent, chosen_at, checked_at, tolerance=tolerance, largest=compressed.rank - 1)
    assert smaller.rank == compressed.rank - 1
    assert float(smaller.inflation.max()) > tolerance


def test_blocks_of_states_change_nothing(latent, monkeypatch):
    whole = compress(latent, sample(9, seed=50), sample(7, seed=90), tolerance=0.0, largest=12)
    monkeypatch.setattr(prepared_kernels, "BLOCK_BYTES", 8 * 10 * 5 * 5 * 4)  # four states
    blocks = compress(latent, sample(9, seed=50), sample(7, seed=90), tolerance=0.0, largest=12)
    torch.testing.assert_close(blocks.inflation, whole.inflation, rtol=1e-7, atol=1e-9)
    monkeypatch.setattr(prepared_kernels, "BLOCK_BYTES", 1)  # less than a state needs
    assert compress(latent, sample(3, seed=50), sample(2, seed=90), tolerance=0.0, largest=3).rank == 3


def test_directions_without_variance_do_not_count(latent):
    at = sample(9, seed=50)
    blind = Sample(at.features, torch.cat([at.W, torch.zeros_like(at.W)], dim=1))
    compressed = compress(latent, at, blind, tolerance=0.05, largest=12)
    assert torch.isfinite(compressed.inflation).all()
    assert len(compressed.inflation) == 18
