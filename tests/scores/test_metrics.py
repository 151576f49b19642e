"""Every score against a closed form, against scipy, or against what must not change it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal, norm

from forcegp.errors import InvalidInput, NumericalError
from forcegp.scores import metrics

ROWS, K = 30, 4


def gaussians(seed: int, rows: int = ROWS, k: int = K) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, covariances and one target per row that is drawn from them."""
    generator = np.random.default_rng(seed)
    factor = generator.normal(size=(rows, k, k))
    covariance = factor @ factor.swapaxes(-1, -2) + 0.1 * np.eye(k)
    mean = generator.normal(size=(rows, k))
    target = mean + (np.linalg.cholesky(covariance) @ generator.normal(size=(rows, k, 1)))[..., 0]
    return mean, covariance, target


def test_joint_density_is_that_of_scipy():
    mean, covariance, target = gaussians(0)
    expected = [-multivariate_normal(m, S).logpdf(y) for m, S, y in zip(mean, covariance, target, strict=True)]
    np.testing.assert_allclose(metrics.negative_log_density(mean, covariance, target), expected, rtol=1e-10)


def test_marginal_density_is_that_of_scipy():
    mean, covariance, target = gaussians(1)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    expected = -norm(mean, np.sqrt(variance)).logpdf(target).mean(axis=0)
    np.testing.assert_allclose(metrics.marginal_negative_log_density(mean, variance, target), expected, rtol=1e-12)


def test_independent_joints_sum_to_the_joint_density():
    mean, covariance, target = gaussians(2)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    diagonal = variance[..., None] * np.eye(K)
    marginal = metrics.marginal_negative_log_density(mean, variance, target)
    assert metrics.negative_log_density(mean, diagonal, target).mean() == pytest.approx(marginal.sum(), rel=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_density_follows_a_change_of_units_and_not_the_order_of_joints(seed):
    mean, covariance, target = gaussians(seed, rows=4)
    generator = np.random.default_rng(seed + 1)
    T = generator.normal(size=(K, K)) + 3.0 * np.eye(K)
    before = metrics.negative_log_density(mean, covariance, target)
    after = metrics.negative_log_density(mean @ T.T, T @ covariance @ T.T, target @ T.T)
    np.testing.assert_allclose(after, before + np.linalg.slogdet(T)[1], rtol=1e-6, atol=1e-8)
    order = generator.permutation(K)
    shuffled = metrics.negative_log_density(mean[:, order], covariance[:, order][:, :, order], target[:, order])
    np.testing.assert_allclose(shuffled, before, rtol=1e-9, atol=1e-9)


def test_the_true_distribution_has_the_lowest_density_score():
    mean, covariance, target = gaussians(3, rows=4000)
    scores = {scale: metrics.negative_log_density(mean, scale * covariance, target).mean() for scale in (0.5, 1.0, 2.0)}
    assert min(scores, key=scores.__getitem__) == 1.0
    entropy = np.mean([multivariate_normal(cov=S).entropy() for S in covariance])
    assert scores[1.0] == pytest.approx(entropy, abs=5 * np.sqrt(K / 2 / 4000))


def test_a_constrained_covariance_without_noise_has_no_density():
    singular = np.stack([np.eye(2), np.diag([1.0, 0.0])])
    with pytest.raises(NumericalError, match=r"row 1 .* not positive definite"):
        metrics.negative_log_density(np.zeros((2, 2)), singular, np.zeros((2, 2)))
    with pytest.raises(NumericalError, match="variance is not positive"):
        metrics.marginal_negative_log_density(np.zeros((2, 1)), np.array([[1.0], [0.0]]), np.zeros((2, 1)))


@pytest.mark.parametrize("level", [0.5, 0.95, 0.99])
def test_coverage_of_the_true_distribution_is_the_level(level):
    rows = 20_000
    mean, covariance, target = gaussians(4, rows=rows)
    coverage = metrics.interval_coverage(mean, np.diagonal(covariance, axis1=1, axis2=2), target, level)
    np.testing.assert_allclose(coverage, level, atol=4 * np.sqrt(level * (1 - level) / rows))


@pytest.mark.parametrize("level", [0.0, 1.0, 95.0])
def test_a_level_is_between_0_and_1(level):
    with pytest.raises(InvalidInput, match="between 0 and 1"):
        metrics.interval_coverage(np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), level)
