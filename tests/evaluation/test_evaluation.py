"""`evaluate` against the same scores computed row by row from `predict`, and its warnings."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal, norm
from tests.data import samples
from tests.posterior.arm import NOISE, arm_data, arm_model

from forcegp.errors import InvalidInput
from forcegp.evaluation import Evaluation, evaluate, predict_rows
from forcegp.evaluation.predicted_rows import ROWS_PER_BLOCK
from forcegp.posterior import load_posterior, save_posterior

ASKED_FOR = ("mae", "mae_noise_free", "rmse", "nlpd", "coverage_95", "constraint_error")


def about(warnings, *topics) -> list[str]:
    """The warnings that speak of one of the topics."""
    return [warning for warning in warnings if any(topic in warning for topic in topics)]


@pytest.fixture(scope="module")
def evaluation(posterior, test_data) -> Evaluation:
    return evaluate(posterior, test_data)


def test_scores_are_those_of_single_predictions(posterior, test_data, evaluation):
    errors, densities, inside, inside_noise_free = [], [], [], []
    for row in range(len(test_data)):
        prediction = posterior.predict(test_data.q[row], test_data.v[row], test_data.u[row])
        mean, covariance = prediction.mean.numpy(), prediction.covariance.numpy()
        noisy = covariance + NOISE**2 * np.eye(3)
        errors.append(mean - test_data.a[row])
        densities.append(-multivariate_normal(mean, noisy).logpdf(test_data.a[row]))
        inside.append(np.abs(errors[-1]) <= norm.ppf(0.975) * np.sqrt(np.diag(noisy)))
        gap = np.abs(mean - test_data.truth["a"][row])
        inside_noise_free.append(gap <= norm.ppf(0.975) * np.sqrt(np.diag(covariance)))
    np.testing.assert_allclose(evaluation.mae_per_joint, np.abs(errors).mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(evaluation.rmse_per_joint, np.sqrt(np.square(errors).mean(axis=0)), rtol=1e-9)
    assert evaluation.nlpd == pytest.approx(np.mean(densities), rel=1e-8)
    np.testing.assert_allclose(evaluation.coverage_95_per_joint, np.mean(inside, axis=0))
    np.testing.assert_allclose(evaluation.coverage_95_noise_free_per_joint, np.mean(inside_noise_free, axis=0))


def test_the_dictionary_holds_every_mean_beside_what_it_is_the_mean_of(evaluation):
    scores = evaluation.to_dict()
    assert json.loads(json.dumps(scores, allow_nan=False)) == scores
    for name in ASKED_FOR:
        assert isinstance(scores[name], float)
        assert len(scores[f"{name}_per_joint"]) == 3
    for name in ("mae", "rmse", "coverage_95", "mae_noise_free", "unknown_force_mae"):
        assert scores[name] == pytest.approx(np.mean(scores[f"{name}_per_joint"]))
    assert len(scores["constraint_error_per_contact"]) == 1
    assert scores["constraint_error"] == pytest.approx(scores["constraint_error_per_contact"][0])
    assert scores["rows"] == 60
    assert scores["noise_floor"] == pytest.approx(NOISE * np.sqrt(2 / np.pi))
    assert about(scores["warnings"], "training rows", "noise std", "system") == []


def test_learning_helps_and_the_constraint_holds(evaluation):
    assert evaluation.mae_noise_free < 0.5 * evaluation.known_physics_mae_noise_free
    assert evaluation.constraint_error <= evaluation.constraint_error_max < 1e-10
    assert max(evaluation.constraint_error_per_joint) < 1e-10


def test_without_truth_and_noise_level_only_measurements_are_scored(posterior, test_data, evaluation):
    bare = dataclasses.replace(test_data, truth={}, noise_std=None, model=None)
    scores = evaluate(posterior, bare).to_dict()
    for name in ("mae_noise_free", "coverage_95_noise_free", "noise_floor", "force_mae", "unknown_force_mae"):
        assert scores[name] is None
        assert scores[f"{name}_per_joint"] is None
    assert scores["multiplier_mae"] is scores["multiplier_mae_per_contact"] is None
    assert scores["mae"] == evaluation.mae
    assert scores["constraint_error"] == evaluation.constraint_error  # of the model's own contact


def test_a_larger_noise_of_the_data_counts_and_another_one_of_the_model_is_named(posterior, test_data):
    std = NOISE * np.array([1.0, 1.4, 3.0])  # the model's is NOISE
    noisier = dataclasses.replace(test_data, noise_std=std)
    predicted = predict_rows(posterior, noisier)
    np.testing.assert_allclose(predicted.measurement_variance - predicted.variance, np.tile(std**2, (60, 1)), rtol=1e-9)
    prediction = posterior.predict(test_data.q[7], test_data.v[7], test_data.u[7])
    joint = multivariate_normal(prediction.mean.numpy(), prediction.covariance.numpy() + np.diag(std**2))
    assert predicted.negative_log_density[7] == pytest.approx(-joint.logpdf(test_data.a[7]), rel=1e-8)
    (warning,) = about(evaluate(posterior, noisier).warnings, "noise std")
    assert "the noise std of the model is 0.05, that of the data 0.15 (joint bend" in warning
    for factor in (0.7, 1.4):
        other = dataclasses.replace(test_data, noise_std=np.full(3, factor * NOISE))
        assert about(evaluate(posterior, other).warnings, "noise std") == []
    other = dataclasses.replace(test_data, noise_std=np.full(3, 0.6 * NOISE))
    assert len(about(evaluate(posterior, other).warnings, "noise std")) == 1


def test_a_larger_noise_of_the_model_counts(posterior, test_data):
    quieter = dataclasses.replace(test_data, noise_std=NOISE * np.array([0.1, 2.0, 0.5]))
    predicted = predict_rows(posterior, quieter)
    expected = np.square(NOISE * np.array([1.0, 2.0, 1.0]))
    np.testing.assert_allclose(
        predicted.measurement_variance - predicted.variance, np.tile(expected, (60, 1)), rtol=1e-9
    )


def test_without_a_stated_noise_that_of_the_model_counts(posterior, test_data):
    predicted = predict_rows(posterior, dataclasses.replace(test_data, noise_std=None))
    np.testing.assert_allclose(predicted.measurement_variance - predicted.variance, NOISE**2, rtol=1e-9)


def test_a_stored_model_scores_the_same(posterior, test_data, evaluation, tmp_path):
    save_posterior(posterior, tmp_path / "run")
    again = evaluate(load_posterior(tmp_path / "run"), test_data)
    np.testing.assert_allclose(again.mae_per_joint, evaluation.mae_per_joint, rtol=1e-9)
    assert again.nlpd == pytest.approx(evaluation.nlpd, rel=1e-9)


def test_without_analytical_mean_the_processes_answer_for_the_known_forces_too(without_mean, test_data):
    evaluation = evaluate(without_mean, test_data)
    predicted = predict_rows(without_mean, test_data)
    known = arm_model().dynamics(*(torch.tensor(x) for x in (test_data.q, test_data.v, test_data.u))).Q_K.numpy()
    carried = predicted.unknown_force - known
    expected = np.abs(carried - test_data.truth["Q_U"]).mean(axis=0)
    np.testing.assert_allclose(evaluation.unknown_force_mae_per_joint, expected, rtol=1e-9)
    assert evaluation.constraint_error_max < 1e-10


def test_blocks_of_rows_join_seamlessly(posterior):
    data = arm_data(ROWS_PER_BLOCK + 3, seed=2)
    calls = []
    whole = predict_rows(posterior, data, lambda done, total: calls.append((done, total)))
    assert calls == [(ROWS_PER_BLOCK, len(data)), (len(data), len(data))]
    ends = predict_rows(posterior, data.rows([0, ROWS_PER_BLOCK - 1, ROWS_PER_BLOCK, len(data) - 1]))
    rows = [0, ROWS_PER_BLOCK - 1, ROWS_PER_BLOCK, len(data) - 1]
    for name in ("mean", "variance", "negative_log_density", "A", "b"):
        np.testing.assert_allclose(getattr(whole, name)[rows], getattr(ends, name), rtol=1e-8, atol=1e-9)


def test_the_constraint_is_that_of_the_data_and_a_model_without_it_is_named(without_contact, test_data):
    evaluation = evaluate(without_contact, test_data)
    assert evaluation.constraint_error > 1e-3
    assert any("contacts of the model are not those of the data" in warning for warning in evaluation.warnings)
    assert evaluation.multiplier_mae is None


def test_training_rows_among_the_test_rows_are_counted(posterior, train, test_data):
    mixed = dataclasses.replace(
        test_data, **{name: np.vstack([getattr(test_data, name)[:-2], getattr(train, name)[:2]]) for name in "qvua"}
    )
    (warning,) = about(evaluate(posterior, mixed).warnings, "training rows")
    assert "2 of 60 test rows have the very (q, v, u) of training rows (the first: row 58)" in warning


def test_other_rows_of_the_training_recording_are_noticed(posterior, train, test_data):
    recorded = posterior.with_settings(data={"metadata": {"log": "monday"}, "episodes": [0]})
    same = dataclasses.replace(test_data, metadata={"log": "monday"})
    (warning,) = about(evaluate(recorded, same).warnings, "same recording")
    assert "same recording" in warning
    tuesday = dataclasses.replace(test_data, metadata={"log": "tuesday"})
    assert about(evaluate(recorded, tuesday).warnings, "same recording") == []
    elsewhere = dataclasses.replace(same, episode=np.ones(60, int))
    assert about(evaluate(recorded, elsewhere).warnings, "same recording") == []


def test_data_of_another_robot_are_refused(posterior):
    with pytest.raises(InvalidInput, match=r"shoulder, elbow.*pan, lift, bend"):
        evaluate(posterior, samples.dataset())
