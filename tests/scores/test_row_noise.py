"""Scores on measurements whose noise differs between rows."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from tests.posterior.arm import NOISE, arm_data, arm_model

from forcegp import score
from forcegp.fit import fit
from forcegp.forces import JointForces
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise
from forcegp.scores import predict_rows

STATED = NOISE * np.where(np.arange(60)[:, None] % 2, 0.2, 4.0) * np.array([1.0, 1.5, 0.5])
QUICK = OptimizerOptions(iterations=15)


@pytest.fixture(scope="module")
def uneven(test_data):
    a = test_data.truth["a"] + STATED * np.random.default_rng(0).normal(size=test_data.a.shape)
    return dataclasses.replace(test_data, a=a, noise_std=STATED)


def with_level(posterior, level):
    """The posterior with another level of noise, conditioned again."""
    log_level = torch.as_tensor(level, dtype=torch.float64).log()
    parameters = {**posterior.hyperparameters, "noise.log_acceleration": log_level}
    return posterior.conditioned(
        posterior.trained, posterior.training, parameters, posterior.result, posterior.settings, posterior.engine
    )


def test_the_noise_of_every_row_is_scored(posterior, uneven):
    level = np.sqrt((STATED**2).mean(0))
    fitted = with_level(posterior, level)
    predicted = predict_rows(fitted, uneven)
    prediction = fitted.predict(uneven.q, uneven.v, uneven.u)
    np.testing.assert_allclose(predicted.measurement_variance, prediction.variance.numpy() + STATED**2, rtol=1e-9)
    for row in (0, 1, 7):
        covariance = prediction.covariance[row].numpy() + np.diag(STATED[row] ** 2)
        density = multivariate_normal(prediction.mean[row].numpy(), covariance).logpdf(uneven.a[row])
        assert predicted.negative_log_density[row] == pytest.approx(-density, rel=1e-7)


def test_a_model_whose_level_is_higher_counts_all_rows_as_noisier(posterior, uneven):
    level = np.sqrt((STATED**2).mean(0))
    predicted = predict_rows(with_level(posterior, 3.0 * level), uneven)
    excess = predicted.measurement_variance - predicted.variance
    np.testing.assert_allclose(excess, 9.0 * STATED**2, rtol=1e-7)
    quieter = predict_rows(with_level(posterior, 0.3 * level), uneven)
    np.testing.assert_allclose(quieter.measurement_variance - quieter.variance, STATED**2, rtol=1e-7)


def test_noise_of_forces_is_added_to_that_of_rows(uneven):
    train = dataclasses.replace(arm_data(30, seed=0, model=arm_model()), noise_std=np.full((30, 3), NOISE))
    fitted = fit(train.model.with_forces(JointForces(), noise=Noise(None, 0.1)), train, restarts=1, options=QUICK)
    predicted = predict_rows(fitted, uneven)
    H = fitted.dynamics(*map(torch.tensor, (uneven.q, uneven.v, uneven.u))).H.numpy()
    expected = STATED**2 + 0.01 * np.square(H).sum(-1)
    np.testing.assert_allclose(predicted.measurement_variance - predicted.variance, expected, rtol=1e-7)


def test_the_floor_is_the_error_of_a_perfect_model(posterior, uneven):
    floor = score(posterior, uneven, horizons=()).columns("noise_floor")
    np.testing.assert_allclose(floor, np.sqrt(2 / np.pi) * STATED.mean(0))
    draws = np.abs(STATED * np.random.default_rng(1).normal(size=(4000, 60, 3))).mean((0, 1))
    np.testing.assert_allclose(floor, draws, rtol=0.02)


def test_prediction_in_blocks_takes_the_right_rows(posterior, uneven, monkeypatch):
    whole = predict_rows(posterior, uneven)
    monkeypatch.setattr("forcegp.scores.predicted_rows.ROWS_PER_BLOCK", 7)
    np.testing.assert_allclose(predict_rows(posterior, uneven).measurement_std, whole.measurement_std, rtol=1e-9)
