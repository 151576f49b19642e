"""Scores of forces against numbers done by hand, dense predictions and a truth that is changed on purpose."""

import dataclasses
import json
import sys

import numpy as np
import pytest
import torch
from scipy.stats import norm
from tests.evaluation.friction import VISCOUS, fitted, friction_data, joint_law
from tests.posterior.arm import arm_data

from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.evaluation import ForceScore, curve_coverage, evaluate, force_scores, normal_force_rests_on_prior
from forcegp.fit import fit
from forcegp.forces import ContactFriction, JointForces, JointFriction, ToolForces
from forcegp.posterior.components import Curve


@pytest.fixture(scope="module")
def data() -> Dataset:
    return friction_data(50, seed=1)


@pytest.fixture(scope="module")
def friction():
    return fitted(JointFriction(), ContactFriction(kernel="linear"))


def test_scores_of_numbers_done_by_hand():
    mean, variance = np.array([[1.0, 0.0], [3.0, 0.0], [0.0, 0.0]]), np.array([[1.0, 0.0], [0.01, 0.0], [4.0, 0.0]])
    score = ForceScore.of(mean, variance, np.array([[0.0, 0.0], [4.0, 0.0], [3.0, 0.0]]))
    assert score.mae_per_column == (pytest.approx(5.0 / 3.0), 0.0)
    assert score.rmse_per_column == (pytest.approx(np.sqrt(11.0 / 3.0)), 0.0)
    assert score.relative_rmse == pytest.approx(np.sqrt(11.0 / 25.0))
    assert score.coverage_95_per_column == (pytest.approx(2.0 / 3.0), None)  # the second column has no width
    assert score.coverage_95 == pytest.approx(2.0 / 3.0)
    assert ForceScore.of(mean, variance, np.zeros((3, 2))).relative_rmse is None
    certain = ForceScore.of(mean, np.zeros((3, 2)), mean)
    assert certain.coverage_95 is None
    assert json.loads(json.dumps(certain.to_dict(), allow_nan=False))["coverage_95_per_column"] == [None, None]


def test_components_are_scored_against_the_parts_of_the_truth(friction, data):
    scores = force_scores(friction, data)
    assert list(scores.joint_force) == ["joint-friction", "contact-friction"]
    assert list(scores.point_force) == ["contact-friction"]
    components = friction.components(data.q, data.v, data.u)
    for name, part in (("joint-friction", "joint-friction"), ("contact-friction", "tool-friction")):
        force, truth = components[name].joint_force, data.truth[f"Q_U.{part}"]
        error = force.mean.numpy() - truth
        score = scores.joint_force[name]
        np.testing.assert_allclose(score.mae_per_column, np.abs(error).mean(0), rtol=1e-9)
        np.testing.assert_allclose(score.rmse, np.sqrt((error**2).mean()), rtol=1e-9)
        assert score.relative_rmse == pytest.approx(np.linalg.norm(error) / np.linalg.norm(truth), rel=1e-9)
        inside = np.abs(error) <= norm.ppf(0.975) * force.std.numpy()
        np.testing.assert_allclose(score.coverage_95_per_column, inside.mean(0), atol=1e-12)
    error = components["contact-friction"].point_force.mean.numpy() - data.truth["force.tool-friction"]
    np.testing.assert_allclose(scores.point_force["contact-friction"].mae_per_column, np.abs(error).mean(0), rtol=1e-9)
    expected = evaluate(friction, data)
    assert scores.multiplier.mae == pytest.approx(expected.multiplier_mae, rel=1e-9)
    assert scores.multiplier.coverage_95 == pytest.approx(expected.multiplier_coverage_95)
    # the right prior knows these forces, each by itself
    assert max(score.relative_rmse for score in scores.joint_force.values()) < 0.1
    assert scores.multiplier.relative_rmse < 0.05
    assert json.loads(json.dumps(scores.to_dict(), allow_nan=False))["rows"] == 50


def test_blocks_of_rows_join_seamlessly(friction, data, monkeypatch):
    whole = force_scores(friction, data)
    monkeypatch.setattr(sys.modules["forcegp.evaluation.predicted_rows"], "ROWS_PER_BLOCK", 7)
    parts = force_scores(friction, data)
    for name, score in whole.joint_force.items():
        assert parts.joint_force[name].mae == pytest.approx(score.mae, rel=1e-9)
    assert parts.multiplier.rmse == pytest.approx(whole.multiplier.rmse, rel=1e-9)


def test_a_truth_that_grows_makes_the_error_grow(friction, data):
    """Twice the true tool friction and the prediction is half of it: a relative error of one half, nearly."""
    doubled = {name: values * (2.0 if name.endswith("tool-friction") else 1.0) for name, values in data.truth.items()}
    score = force_scores(friction, dataclasses.replace(data, truth=doubled)).point_force["contact-friction"]
    assert score.relative_rmse == pytest.approx(0.5, abs=0.05)
    assert score.coverage_95 < 0.2


def test_what_the_truth_does_not_know_is_not_scored(friction, data):
    bare = force_scores(friction, dataclasses.replace(data, truth={}))
    assert (bare.joint_force, bare.point_force, bare.multiplier) == ({}, {}, None)
    only = {name: data.truth[name] for name in ("Q_U.joint-friction", "lambda")}
    some = force_scores(friction, dataclasses.replace(data, truth=only))
    assert list(some.joint_force) == ["joint-friction"]
    assert some.point_force == {}
    assert some.multiplier is not None


def test_two_components_that_claim_one_truth_are_not_scored(data):
    model = fitted(ContactFriction(kernel="linear"), ToolForces(inputs=("position",)), iterations=1)
    assert force_scores(model, data).joint_force == {}


@pytest.mark.filterwarnings("ignore:the accelerations show no force")  # one iteration finds none
def test_without_analytical_mean_components_are_not_friction_alone(data):
    model = fitted(JointFriction(), iterations=1, mean=False)
    scores = force_scores(model, data)
    assert scores.joint_force == {}
    assert scores.multiplier is not None


def test_a_model_of_accelerations_has_no_forces_to_score(data):
    scores = force_scores(fit(data.model.black_box(), friction_data(10, 0)), data)
    assert scores.to_dict() == {"rows": 50, "joint_force": {}, "point_force": {}, "multiplier": None}


def test_data_of_other_joints_are_refused(friction, data):
    other = Dataset(
        q=data.q[:, :2], v=data.v[:, :2], u=data.u[:, :2], a=data.a[:, :2], time=data.time,
        joint_names=("a", "b"), units=data.units,
    )  # fmt: skip
    with pytest.raises(InvalidInput, match="joints of dataset are a, b"):
        force_scores(friction, other)


def curve(mean: list[float], std: list[float], low: float, high: float) -> Curve:
    column = torch.linspace(0.0, 1.0, len(mean), dtype=torch.float64)[:, None]
    tensors = (torch.tensor(values, dtype=torch.float64) for values in (mean, std))
    return Curve("f", "N", ("v [m/s]",), column, *tensors, torch.tensor([[low], [high]], dtype=torch.float64))


def test_coverage_of_a_curve_counts_the_points_in_the_visited_range():
    given = curve([0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 0.1, 0.1, 0.1, 0.1], 0.0, 1.0)
    assert curve_coverage(given, lambda v: 4.0 * v) == 1.0  # exact at rest, where there is no width
    assert curve_coverage(given, lambda v: 4.0 * v + 0.15) == pytest.approx(0.8)
    assert curve_coverage(given, lambda v: 4.0 * v + 0.3) == 0.0
    assert curve_coverage(given, lambda v: 4.0 * v + 0.15 * (v > 0), probability=0.5) == pytest.approx(0.2)
    narrow = curve([0.0, 1.0, 2.0, 9.0, 9.0], [0.1] * 5, 0.0, 0.5)
    assert curve_coverage(narrow, lambda v: 4.0 * v) == 1.0
    with pytest.raises(InvalidInput, match="visited range"):
        curve_coverage(curve([0.0, 1.0], [0.1, 0.1], 2.0, 3.0), lambda v: v)
    with pytest.raises(InvalidInput, match="one number for each"):
        curve_coverage(given, lambda v: v[:, None])


def test_curves_of_the_right_prior_contain_the_law(friction):
    shares = [curve_coverage(friction.curve(f"joint-friction {joint}"), joint_law) for joint in ("pan", "lift", "bend")]
    assert np.mean(shares) > 0.6
    sliding = friction.curve("contact-friction sliding")
    assert curve_coverage(sliding, lambda speed: 3.0 * VISCOUS * speed) < 0.2
    two = fitted(ToolForces(), iterations=1)
    with pytest.raises(InvalidInput, match="2 features"):
        curve_coverage(two.curve("force-tangent-1", np.zeros((4, 2))), joint_law)


@pytest.mark.parametrize(
    ("forces", "rests"),
    [
        ((JointForces(),), True),
        ((JointForces(), JointFriction()), True),
        ((ToolForces(frame="hand", point=(0.0, 0.0, 0.2), axes="world"),), True),
        ((ToolForces(),), False),
        ((JointFriction(), ContactFriction()), False),
        ((), False),
    ],
    ids=str,
)
def test_only_a_force_that_is_free_along_the_normal_rests_on_the_prior(forces, rests):
    assert normal_force_rests_on_prior(fitted(*forces, points=15, iterations=1)) is rests


def test_without_contacts_there_is_no_normal_force(without_contact):
    assert not normal_force_rests_on_prior(without_contact)


def test_a_force_that_rests_on_the_prior_may_be_anything_and_accelerations_stay(data):
    """The criterion against its meaning: add a function times A^T to the joint forces, and only lambda changes."""
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]
    dynamics = data.model.dynamics(*states)
    pressing = 7.0 * torch.cos(states[0][:, :1]) * dynamics.A[:, 0]
    zero = torch.zeros_like(pressing)
    torch.testing.assert_close(dynamics.acceleration(pressing), dynamics.acceleration(zero), rtol=0.0, atol=1e-9)
    assert (dynamics.multiplier(pressing) - dynamics.multiplier(zero)).abs().min() > 1.0
    assert arm_data(3, 0).model.contacts
