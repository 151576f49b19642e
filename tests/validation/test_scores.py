"""Scores against closed forms: inverse dynamics for forces, Gaussian densities and counts for intervals."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.stats import norm
from tests.validation.moving_arm import given_system, moving_arm

from forcegp.fit import fit
from forcegp.forces import Rotor
from forcegp.model import Model
from forcegp.validation.page import _at_rest
from forcegp.validation.scores import (
    LEVELS,
    acceleration_scores,
    force_errors,
    mass_matrices,
    normalized_error,
    outside_range,
    over_joints,
)

SIGMA = np.array([3.0, 2.0, 5.0])


@pytest.fixture(scope="module")
def test_rows():
    return dataclasses.replace(moving_arm(0.4, 1), noise_std=None)


@pytest.fixture(scope="module")
def scores(test_rows):
    """Of the URDF alone with a given noise: its prediction and its density are known in closed form."""
    model = given_system()
    posterior = fit(model.with_forces(noise=tuple(SIGMA)), test_rows, points=5)
    return acceleration_scores(posterior, test_rows, mass_matrices(test_rows, model))[0]


def predicted(test_rows) -> np.ndarray:
    robot = given_system().robot
    return np.array(
        [
            np.linalg.solve(robot.mass_matrix(q).numpy(), u - robot.bias_forces(q, v).numpy())
            for q, v, u in zip(*map(torch.tensor, (test_rows.q, test_rows.v)), test_rows.u, strict=True)
        ]
    )


def test_errors_of_the_acceleration(scores, test_rows):
    error = predicted(test_rows) - test_rows.a
    assert np.allclose(scores["rmse"], np.sqrt((error**2).mean(0)))
    assert np.allclose(scores["mae"], np.abs(error).mean(0))
    assert np.allclose(scores["nrmse"], np.sqrt((error**2).mean(0)) / test_rows.a.std(0))


def test_force_errors_are_the_residuals_of_inverse_dynamics(scores, test_rows):
    """M (a_predicted - a) = (u - bias) - M a: what inverse dynamics leaves of the torque, with the model's own M."""
    robot = given_system().robot
    q, v, a = map(torch.tensor, (test_rows.q, test_rows.v, test_rows.a))
    residual = test_rows.u - robot.inverse_dynamics(q, v, a).numpy()
    assert np.allclose(scores["force_rms"], np.sqrt((residual**2).mean(0)))
    assert np.allclose(scores["force_mae"], np.abs(residual).mean(0))


def test_densities_and_intervals_are_those_of_the_noise(scores, test_rows):
    error = test_rows.a - predicted(test_rows)
    density = norm.logpdf(error, scale=SIGMA)
    assert scores["nlpd"] == pytest.approx(-density.sum(1).mean())
    assert np.allclose(scores["nlpd_per_joint"], -density.mean(0))
    for level, covered in zip(LEVELS, scores["coverage"], strict=True):
        half = norm.ppf(0.5 + 0.5 * level) * SIGMA
        assert np.allclose(covered, (np.abs(error) <= half).mean(0))
    assert scores["levels"][4] == 0.5
    assert 0.95 in scores["levels"]
    assert np.allclose(scores["noise_std"], SIGMA)


def test_stretches_of_time_make_up_the_whole(scores, test_rows):
    """Equal stretches: means of squares over them are those of all rows, and so are densities."""
    stretches = scores["stretches"]
    assert stretches["seconds"] == pytest.approx(0.39 / 20)
    error = predicted(test_rows) - test_rows.a
    number = (test_rows.time / stretches["seconds"]).astype(int)
    rows = np.bincount(number)
    assert len(stretches["force_rms"]) == len(rows)
    force = np.average(np.square(stretches["force_rms"]), weights=rows)
    assert force == pytest.approx(np.square(scores["force_rms"]).mean())
    assert np.average(np.square(stretches["nrmse"]), weights=rows) == pytest.approx(np.square(scores["nrmse"]).mean())
    assert np.average(stretches["nlpd"], weights=rows) == pytest.approx(scores["nlpd"])
    first = number == 0
    assert stretches["nrmse"][0] == pytest.approx(np.sqrt(((error / test_rows.a.std(0))[first] ** 2).mean()))


def test_the_mass_matrix_counts_rotors(test_rows):
    model = given_system()
    with_rotors = Model(model.robot, (), (*model.forces, Rotor((0.1, 0.2, 0.3))))
    added = mass_matrices(test_rows, with_rotors) - mass_matrices(test_rows, model)
    assert np.allclose(added, np.diag([0.1, 0.2, 0.3]))
    change = force_errors(np.ones((len(test_rows), 3)), np.zeros((len(test_rows), 3)), added)
    assert np.allclose(change, [0.1, 0.2, 0.3])


def test_normalised_errors_are_one_for_the_mean_and_unknown_for_what_never_changes():
    generator = np.random.default_rng(0)
    target = generator.normal(size=(50, 3))
    target[:, 1] = 2.0 + 1e-12 * target[:, 1]  # rounding, as of a cart across its wheels
    found = normalized_error(np.broadcast_to(target.mean(0), target.shape) + 0.0, target)
    assert np.isnan(found[1])
    assert np.allclose(found[[0, 2]], 1.0)


def test_over_joints():
    assert over_joints("nrmse", [1.0, None, 3.0]) == 2.0
    assert over_joints("force_rms", [3.0, 4.0]) == pytest.approx(np.sqrt(12.5))
    assert over_joints("nrmse", [None]) is None


def test_no_acceleration_at_all_is_scored_beside_the_models(scores, test_rows):
    """A wrist that hardly moves is predicted well by not moving: that is the score to beat."""
    robot = given_system().robot
    force = [robot.mass_matrix(q).numpy() @ a for q, a in zip(torch.tensor(test_rows.q), test_rows.a, strict=True)]
    assert np.allclose(scores["force_rms_at_rest"], np.sqrt(np.square(force).mean(0)))


@pytest.mark.parametrize(("best", "said"), [(0.05, False), (0.09, True)])
def test_the_page_names_joints_where_the_score_says_nothing(best, said):
    def spread(value):
        return {"median": value, "least": value, "largest": value}

    model = {
        "force_rms_per_joint": [spread(0.1), spread(best)],
        "force_rms_at_rest_per_joint": [spread(5.0), spread(0.1)],
    }
    found = _at_rest({"one": model}, {"joint_names": ["elbow", "wrist"]})
    assert found == {"levels": "elbow 5, wrist 0.1", "empty": ["wrist"] if said else []}


def test_what_a_reader_has_to_know_comes_with_the_scores(test_rows):
    model = given_system()
    sure = fit(model.with_forces(noise=1e-3), test_rows, points=5)
    scores, doubted = acceleration_scores(sure, test_rows, mass_matrices(test_rows, model))
    inside = np.mean(scores["coverage"][LEVELS.index(0.95)])
    assert inside < 0.9
    assert any(f"the 95 % intervals hold {inside:.0%} of the measurements" in sentence for sentence in doubted)


def test_rows_outside_the_training_range_are_scored_apart(test_rows):
    model, train = given_system(), test_rows.rows(slice(0, 20))
    outside = outside_range(train, test_rows)
    assert not outside[:20].any()
    for row in range(20, 40):
        beyond = [
            not getattr(train, name)[:, joint].min() <= getattr(test_rows, name)[row, joint] <= seen.max()
            for name in ("q", "v")
            for joint, seen in enumerate(getattr(train, name).T)
        ]
        assert outside[row] == any(beyond)
    posterior = fit(model.with_forces(noise=tuple(SIGMA)), test_rows, points=5)
    found = acceleration_scores(posterior, test_rows, mass_matrices(test_rows, model), outside)[0]["range"]
    error, spread = predicted(test_rows) - test_rows.a, test_rows.a.std(axis=0)
    for side, rows in (("inside", ~outside), ("outside", outside)):
        assert found[side]["rows"] == rows.sum() > 0
        assert found[side]["nrmse"] == pytest.approx(np.mean(np.sqrt(np.square(error[rows]).mean(0)) / spread))
        inside = np.abs(error[rows]) <= norm.ppf(0.975) * SIGMA
        assert found[side]["coverage_95"] == pytest.approx(inside.mean())
