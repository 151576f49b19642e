"""Every score against scipy, by hand, or against what must not change it."""

import numpy as np
import pytest
import torch

from forcegp.errors import NumericalError
from forcegp.scores.accuracy import metrics, negative_log_density, over_columns


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
