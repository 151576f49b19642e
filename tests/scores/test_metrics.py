"""Every score against scipy, or against what must not change it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from forcegp.errors import NumericalError
from forcegp.scores import predicted_rows as metrics

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


@given(st.integers(0, 2**32 - 1))
def test_density_follows_a_change_of_units(seed):
    mean, covariance, target = gaussians(seed, rows=4)
    T = np.random.default_rng(seed + 1).normal(size=(K, K)) + 3.0 * np.eye(K)
    before = metrics.negative_log_density(mean, covariance, target)
    after = metrics.negative_log_density(mean @ T.T, T @ covariance @ T.T, target @ T.T)
    np.testing.assert_allclose(after, before + np.linalg.slogdet(T)[1], rtol=1e-6, atol=1e-8)


def test_a_constrained_covariance_without_noise_has_no_density():
    singular = np.stack([np.eye(2), np.diag([1.0, 0.0])])
    with pytest.raises(NumericalError, match=r"row 1 .* not positive definite"):
        metrics.negative_log_density(np.zeros((2, 2)), singular, np.zeros((2, 2)))


@pytest.mark.parametrize("level", [0.5, 0.95, 0.99])
def test_coverage_of_the_true_distribution_is_the_level(level):
    rows = 20_000
    mean, covariance, target = gaussians(4, rows=rows)
    coverage = metrics.interval_coverage(mean, np.diagonal(covariance, axis1=1, axis2=2), target, level)
    np.testing.assert_allclose(coverage, level, atol=4 * np.sqrt(level * (1 - level) / rows))
