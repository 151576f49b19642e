"""Every score against scipy, by hand, or against what must not change it."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from forcegp.errors import NumericalError
from forcegp.scores.accuracy import metrics, negative_log_density, over_columns

ROWS, K = 30, 4


def gaussians(seed: int, rows: int = ROWS, k: int = K) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Means, covariances and one target per row that is drawn from them."""
    generator = np.random.default_rng(seed)
    factor = generator.normal(size=(rows, k, k))
    covariance = factor @ factor.swapaxes(-1, -2) + 0.1 * np.eye(k)
    mean = generator.normal(size=(rows, k))
    target = mean + (np.linalg.cholesky(covariance) @ generator.normal(size=(rows, k, 1)))[..., 0]
    return torch.tensor(mean), torch.tensor(covariance), torch.tensor(target)


def test_joint_density_is_that_of_scipy():
    mean, covariance, target = gaussians(0)
    expected = [-multivariate_normal(m, S).logpdf(y) for m, S, y in zip(mean, covariance, target, strict=True)]
    np.testing.assert_allclose(negative_log_density(mean, covariance, target), expected, rtol=1e-10)


def test_a_constrained_covariance_without_noise_has_no_density():
    singular = torch.stack([torch.eye(2), torch.diag(torch.tensor([1.0, 0.0]))]).double()
    with pytest.raises(NumericalError, match=r"row 1 .* not positive definite"):
        negative_log_density(torch.zeros(2, 2).double(), singular, torch.zeros(2, 2).double())


def test_errors_done_by_hand():
    mean, variance = np.array([[1.0, 0.0], [3.0, 0.0], [0.0, 0.0]]), np.array([[1.0, 0.0], [0.01, 0.0], [4.0, 0.0]])
    found = metrics(mean, variance, np.array([[0.0, 0.0], [4.0, 0.0], [3.0, 0.0]]))
    assert found["mae"] == [pytest.approx(5.0 / 3.0), 0.0]
    assert found["rmse"] == [pytest.approx(np.sqrt(11.0 / 3.0)), 0.0]
    assert found["largest"] == [3.0, 0.0]
    assert found["relative_rmse"] == [pytest.approx(np.sqrt(11.0 / 25.0))]
    assert found["coverage_95"] == [pytest.approx(2.0 / 3.0), None]  # the second column has no width
    assert set(metrics(mean, None, np.zeros((3, 2)))) == {"mae", "rmse", "largest"}


def test_over_all_joints():
    assert over_columns("acceleration", "nrmse", [1.0, None, 3.0]) == 2.0
    assert over_columns("true acceleration", "rmse", [3.0, 4.0]) == 3.5
    assert over_columns("force", "rmse", [3.0, 4.0]) == pytest.approx(np.sqrt(12.5))
    assert over_columns("acceleration", "nrmse", [None]) is None
