"""Scores of one model on the rows of a log: against single predictions, closed forms, and a truth that is changed."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pinocchio
import pytest
import torch
from scipy.stats import multivariate_normal, norm
from tests.posterior.arm import NOISE, arm_data, arm_model
from tests.scores.moving_arm import given_system, moving_arm

from forcegp import Noise, score
from forcegp.data.views import BLOCK
from forcegp.errors import InvalidInput
from forcegp.fit import fit
from forcegp.forces import Rotor
from forcegp.model import Model
from forcegp.progress import watched
from forcegp.scores.accuracy import LEVELS, by_stretch, force_errors, mass_matrices, predict_rows, row_scores

TRUE = "true acceleration"
SIGMA = np.array([3.0, 2.0, 5.0])


def scored(posterior, data):
    return score(posterior, data, horizons=())


@pytest.fixture(scope="module")
def scores(posterior, test_data):
    return scored(posterior, test_data)


def test_torques_are_those_of_inverse_dynamics_beside_the_recorded_ones():
    """Of a robot that knows its bodies and damping, by Pinocchio; a share of 1 is the mean of the torque."""
    model = arm_model().with_contacts([])
    data = dataclasses.replace(arm_data(40, 3), model=model, truth={})
    posterior = fit(model.with_forces(Rotor(0.01), noise=Noise(0.1)), data)
    urdf, each = pinocchio.buildModelFromXML(model.robot.urdf_text), zip(data.q, data.v, data.a, strict=True)
    needed = np.array([pinocchio.rnea(urdf, urdf.createData(), *row) for row in each]) + 0.01 * data.a
    error, found = np.sqrt(np.square(needed - data.u).mean(0)), scored(posterior, data)
    np.testing.assert_allclose(found.columns("rmse", "torque"), error, rtol=1e-9)
    np.testing.assert_allclose(found.columns("share", "torque"), error / data.u.std(0), rtol=1e-9)


def test_errors_of_a_slow_stretch_relate_to_the_whole_recording(posterior, test_data):
    slow = test_data.rows(np.abs(test_data.a).sum(1) < np.median(np.abs(test_data.a).sum(1)))
    alone, related = (row_scores(posterior, slow, whole=each)[0]["acceleration"] for each in (None, test_data))
    ratio = np.array(alone["nrmse"]) / np.array(related["nrmse"])
    np.testing.assert_allclose(ratio, test_data.a.std(0) / slow.a.std(0), rtol=1e-9)
    assert alone["rmse"] == related["rmse"]


def test_scores_are_those_of_single_predictions(posterior, test_data, scores):
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
    np.testing.assert_allclose(scores.columns("mae"), np.abs(errors).mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(scores.columns("rmse"), np.sqrt(np.square(errors).mean(axis=0)), rtol=1e-9)
    assert scores.value("nlpd", "all joints") == pytest.approx(np.mean(densities), rel=1e-8)
    np.testing.assert_allclose(scores.columns("coverage_95"), np.mean(inside, axis=0))
    np.testing.assert_allclose(scores.columns("coverage_95", TRUE), np.mean(inside_noise_free, axis=0))
    assert scores.value("mae") == pytest.approx(np.abs(errors).mean())
    assert scores.value("noise_floor") == pytest.approx(NOISE * np.sqrt(2 / np.pi))
    assert json.loads(json.dumps(scores.to_dict(), allow_nan=False)) == scores.to_dict()
    assert not any("training rows" in each or "noise std" in each for each in scores.warnings)


def test_learning_helps_and_the_constraint_holds(scores):
    assert scores.value("mae", TRUE) < 0.5 * scores.value("known_physics_mae", TRUE)
    assert scores.value("mae", "constraint") <= scores.value("largest", "constraint") < 1e-10


def test_without_truth_only_measurements_are_scored_and_the_rest_is_named(posterior, test_data, scores):
    bare = scored(posterior, dataclasses.replace(test_data, truth={}, noise_std=None))
    assert set(bare.quantities()) == {"acceleration", "all joints", "force", "constraint", "torque"}
    assert bare.value("mae") == scores.value("mae")
    assert bare.value("mae", "constraint") == scores.value("mae", "constraint")  # of the model's own contact
    with pytest.raises(InvalidInput, match=r"hold no mae of unknown force; they hold .* need their truth in the log"):
        bare.value("mae", "unknown force")
    with pytest.raises(InvalidInput, match=r"no noise_floor of acceleration.*coverage_95"):
        bare.value("noise_floor")


def test_without_analytical_mean_the_processes_answer_for_the_known_forces_too(without_mean, test_data):
    predicted = predict_rows(without_mean, test_data)
    known = arm_model().dynamics(*(torch.tensor(x) for x in (test_data.q, test_data.v, test_data.u))).Q_K.numpy()
    expected = np.abs(predicted["unknown_force"] - known - test_data.truth["Q_U"]).mean(axis=0)
    np.testing.assert_allclose(scored(without_mean, test_data).columns("mae", "unknown force"), expected, rtol=1e-9)


def test_blocks_of_rows_join_seamlessly(posterior):
    data, calls = arm_data(BLOCK + 3, seed=2), []
    with watched(lambda done, total, _: calls.append((done, total))):
        whole = predict_rows(posterior, data)
    assert calls == [(BLOCK, len(data)), (len(data), len(data))]
    rows = [0, BLOCK - 1, BLOCK, len(data) - 1]
    ends = predict_rows(posterior, data.rows(rows))
    for name in ("mean", "variance", "negative_log_density", "residual"):
        np.testing.assert_allclose(whole[name][rows], ends[name], rtol=1e-8, atol=1e-9)


# ---------------------------------------------------------------- known physics alone, in closed form


@pytest.fixture(scope="module")
def swinging():
    return dataclasses.replace(moving_arm(0.4, 1), noise_std=None)


@pytest.fixture(scope="module")
def known(swinging):
    """Table and stretches of the URDF alone with a given noise."""
    model = given_system()
    posterior = fit(model.with_forces(noise=tuple(SIGMA)), swinging, points=5)
    return row_scores(posterior, swinging, mass_matrices(swinging, model))


def off(data) -> np.ndarray:
    robot, states = given_system().robot, zip(*map(torch.tensor, (data.q, data.v)), data.u, strict=True)
    forces = [(robot.mass_matrix(q).numpy(), u - robot.bias_forces(q, v).numpy()) for q, v, u in states]
    return np.array([np.linalg.solve(mass, force) for mass, force in forces]) - data.a


def test_force_errors_are_the_residuals_of_inverse_dynamics(known, swinging):
    """M (a_predicted - a) = (u - bias) - M a: what inverse dynamics leaves of the torque, with the model's own M."""
    robot = given_system().robot
    q, v, a = map(torch.tensor, (swinging.q, swinging.v, swinging.a))
    residual = swinging.u - robot.inverse_dynamics(q, v, a).numpy()
    table, _ = known
    assert np.allclose(table["force"]["rmse"], np.sqrt((residual**2).mean(0)))
    assert np.allclose(table["force"]["mae"], np.abs(residual).mean(0))


def test_densities_and_intervals_are_those_of_the_noise(known, swinging):
    error, density = off(swinging), norm.logpdf(off(swinging), scale=SIGMA)
    table, _ = known
    assert table["all joints"]["nlpd"] == pytest.approx([-density.sum(1).mean()])
    assert np.allclose(table["acceleration"]["nlpd"], -density.mean(0))
    assert np.allclose(table["acceleration"]["nrmse"], np.sqrt((error**2).mean(0)) / swinging.a.std(0))
    assert np.allclose(table["acceleration"]["noise_std"], SIGMA)
    for level in LEVELS:
        inside = (np.abs(error) <= norm.ppf(0.5 + 0.5 * level) * SIGMA).mean(0)
        assert np.allclose(table["acceleration"][f"coverage_{100 * level:.0f}"], inside)


def test_stretches_of_time_make_up_the_whole(known, swinging):
    """Equal stretches of 20 in all: means of squares over them are those of all rows."""
    table, stretches = known
    number = (swinging.time / (0.39 / 20)).astype(int)
    rows = np.bincount(number)
    assert len(stretches) == len(rows)
    assert np.average(stretches, weights=rows) == pytest.approx(np.square(table["force"]["rmse"]).mean())
    first = force_errors(off(swinging), 0.0 * swinging.v, mass_matrices(swinging, given_system()))[number == 0]
    assert stretches[0] == pytest.approx((first**2).mean())


def test_torques_are_compared_with_those_of_the_log_whatever_the_common_mass(known, swinging):
    model = given_system()
    posterior = fit(model.with_forces(noise=tuple(SIGMA)), swinging, points=5)
    assert row_scores(posterior, swinging, 2.0 * mass_matrices(swinging, model))[1] == pytest.approx(known[1])


def test_stretches_begin_anew_in_every_episode(unchecked):
    """Two of 40 s are cut into ten of 4 s each, and its last row."""
    seconds = np.tile(np.arange(41.0), 2)
    rows = SimpleNamespace(time=seconds + np.repeat([0.0, 99.5], 41), episode=np.repeat([7, 3], 41), episodes=(7, 3))
    own = [*np.arange(1.5, 40.0, 4.0), 40.0]
    assert by_stretch(seconds, rows) == own + own


def test_the_mass_matrix_counts_rotors(swinging):
    model = given_system()
    with_rotors = Model(model.robot, (), (*model.forces, Rotor((0.1, 0.2, 0.3))))
    added = mass_matrices(swinging, with_rotors) - mass_matrices(swinging, model)
    assert np.allclose(added, np.diag([0.1, 0.2, 0.3]))
    change = force_errors(np.ones((len(swinging), 3)), np.zeros((len(swinging), 3)), added)
    assert np.allclose(change, [0.1, 0.2, 0.3])


def test_a_joint_that_never_moves_has_no_normalised_error(swinging):
    a = swinging.a.copy()
    a[:, 1] = 2.0 + 1e-12 * a[:, 1]  # rounding, as of a cart across its wheels
    posterior = fit(given_system().with_forces(noise=tuple(SIGMA)), swinging, points=5)
    scores = scored(posterior, dataclasses.replace(swinging, a=a))
    assert [each is None for each in scores.columns("nrmse")] == [False, True, False]
    assert scores.value("nrmse") is not None
