"""What stands beside the scores of a model, so that nobody has to find it out."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal
from tests.posterior.arm import NOISE, arm_data

from forcegp import score
from forcegp.fit import fit
from forcegp.forces import JointForces, JointFriction
from forcegp.inference import OptimizerOptions
from forcegp.scores import unfinished_search
from forcegp.scores.accuracy import poor_scores, predict_rows, rows_outside

TRUE = "true acceleration"
QUICK = {"restarts": 1, "options": OptimizerOptions()}


@pytest.fixture(scope="module")
def friction():
    data = arm_data(40, 0)
    return fit(data.model.with_forces(JointFriction()), data, **QUICK)


def scored(posterior, data):
    return score(posterior, data, horizons=())


def about(warnings, topic) -> list[str]:
    return [warning for warning in warnings if topic in warning]


def test_of_a_good_model_nothing_is_said(friction):
    assert friction.result.converged
    assert scored(friction, arm_data(60, 1)).warnings == ()


def test_a_search_that_did_not_end_is_named():
    data = arm_data(20, 0)
    posterior = fit(data.model.with_forces(JointForces()), data, restarts=1, options=OptimizerOptions(iterations=2))
    (sentence,) = map(str, unfinished_search(posterior))
    assert "did not converge (stopped at the limit of 2 iterations" in sentence
    assert about(scored(posterior, arm_data(20, 1)).warnings, "did not converge") == [sentence]


def test_rows_outside_of_the_training_range_are_named_with_the_worst_joint(friction):
    data = arm_data(60, 1)
    v = data.v.copy()
    v[:6, 1] += 9.0
    (sentence,) = about(scored(friction, dataclasses.replace(data, v=v)).warnings, "outside")
    assert sentence.startswith("10% of the rows lie outside of the range that the model was trained in")
    assert "(worst: v of lift is" in sentence


def test_a_model_that_is_worse_than_its_known_forces_is_named(friction):
    """Without the friction that it has learned: u holds it already."""
    data = arm_data(60, 1)
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]
    a = data.model.dynamics(*states).acceleration_map().offset.numpy()
    found = scored(friction, dataclasses.replace(data, a=a, truth={"a": a}))
    (sentence,) = about(found.warnings, "worse here than its known forces alone")
    assert f"noise-free MAE {found.value('mae', TRUE):.3g} against 0" in sentence


def test_a_joint_that_hides_in_the_mean_is_named(friction):
    """One joint lacks the friction that was learned, and another has ten times the variance of noise that is stated."""
    data = arm_data(200, 1)
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]
    known = data.model.dynamics(*states).acceleration_map().offset.numpy()
    a, measured = data.truth["a"].copy(), data.a.copy()
    a[:, 0] = known[:, 0]
    measured[:, 0] = known[:, 0] + (data.a - data.truth["a"])[:, 0]
    names, found = data.joint_names, scored(friction, dataclasses.replace(data, a=measured, truth={"a": a}))
    assert found.value("mae", TRUE) < found.value("known_physics_mae", TRUE)
    (sentence,) = about(found.warnings, "worse here than")
    assert f"at 1 of {len(names)} joints, {names[0]} " in sentence
    noisy = data.a.copy()
    noisy[:, 2] += 3.0 * NOISE * np.random.default_rng(0).normal(size=len(noisy))
    found = scored(friction, dataclasses.replace(data, a=noisy))
    assert found.value("coverage_95") > 0.85
    (sentence,) = about(found.warnings, "95 % intervals")
    assert f"of the measurements ({names[2]} {found.columns('coverage_95')[2]:.0%}):" in sentence


# ---------------------------------------------------------------- rows, noise and contacts that differ


def test_a_larger_noise_of_the_data_counts(posterior, test_data):
    std = NOISE * np.array([1.0, 1.4, 3.0])  # the model's is NOISE
    predicted = predict_rows(posterior, dataclasses.replace(test_data, noise_std=std))
    assert_allclose(predicted["measurement_variance"] - predicted["variance"], np.tile(std**2, (60, 1)), rtol=1e-9)
    prediction = posterior.predict(test_data.q[7], test_data.v[7], test_data.u[7])
    joint = multivariate_normal(prediction.mean.numpy(), prediction.covariance.numpy() + np.diag(std**2))
    assert predicted["negative_log_density"][7] == pytest.approx(-joint.logpdf(test_data.a[7]), rel=1e-8)


@pytest.mark.parametrize(("stated", "counts"), [((0.1, 2.0, 0.5), (1.0, 2.0, 1.0)), (None, (1.0, 1.0, 1.0))])
def test_a_larger_noise_of_the_model_counts(posterior, test_data, stated, counts):
    quieter = dataclasses.replace(test_data, noise_std=None if stated is None else NOISE * np.array(stated))
    predicted = predict_rows(posterior, quieter)
    added = predicted["measurement_variance"] - predicted["variance"]
    assert_allclose(added, np.tile(np.square(NOISE * np.array(counts)), (60, 1)), rtol=1e-9)


def test_the_constraint_is_that_of_the_data_and_a_model_without_it_is_named(without_contact, test_data):
    found = scored(without_contact, test_data)
    assert found.value("mae", "constraint") > 1e-3
    assert about(found.warnings, "contacts of the model are not those of the data")
    assert "contact force" not in found.quantities()


def test_rows_that_were_trained_on_are_named(posterior, train, test_data):
    mixed = {name: np.vstack([getattr(test_data, name)[:-2], getattr(train, name)[:2]]) for name in "qvua"}
    (warning,) = about(scored(posterior, dataclasses.replace(test_data, **mixed)).warnings, "training rows")
    assert "2 of 60 test rows have the very (q, v, u) of training rows (the first: row 58)" in warning


# ---------------------------------------------------------------- from where on something is said

JOINTS = SimpleNamespace(joint_names=("a", "b"), noise_std=torch.tensor([1.0, 1.0]))


def poor(mae, known, inside=(0.95, 0.95), rows=400) -> list[str]:
    """Subjects of the doubts about a table of two joints, with noise of standard deviation 1."""
    table = {"acceleration": {"mae": list(mae), "known_physics_mae": list(known), "coverage_95": list(inside)}}
    return [doubt.about for doubt in poor_scores(JOINTS, range(rows), table)]


@pytest.mark.usefixtures("unchecked")  # its model is none
def test_a_model_is_worse_from_a_percent_on_in_the_mean_and_a_fifth_at_a_joint():
    assert poor((5.0, 5.0), (5.0, 5.0)) == poor((5.04, 5.04), (5.0, 5.0)) == []
    assert poor((5.08, 5.08), (5.0, 5.0)) == ["error"]
    assert poor((5.9, 4.0), (5.0, 5.0)) == []
    assert poor((6.1, 3.0), (5.0, 5.0)) == ["error"]
    assert poor((0.19, 4.0), (0.1, 5.0)) == [], "a tenth of the noise is nothing"
    assert poor((0.21, 4.0), (0.1, 5.0)) == ["error"]


@pytest.mark.usefixtures("unchecked")  # its model is none
def test_intervals_miss_below_nine_tenths_in_the_mean_or_fifteen_hundredths_at_a_joint():
    assert poor((1.0, 1.0), (5.0, 5.0), (0.91, 0.91)) == []
    assert poor((1.0, 1.0), (5.0, 5.0), (0.89, 0.89)) == ["coverage"]
    assert poor((1.0, 1.0), (5.0, 5.0), (0.81, 1.0)) == []
    assert poor((1.0, 1.0), (5.0, 5.0), (0.79, 1.0)) == ["coverage"]
    few = {"mae": [1.0, 1.0], "known_physics_mae": [5.0, 5.0], "coverage_95": [0.72, 0.74]}
    (doubt,) = poor_scores(JOINTS, range(16), {"acceleration": few})  # chance leaves .732 of 16 rows
    assert "(a 72%)" in doubt.what


class Rows:
    def __init__(self, q):
        self.q, self.v = q, np.zeros_like(q)

    def __len__(self):
        return len(self.q)


@pytest.mark.usefixtures("unchecked")  # its model is none
@pytest.mark.parametrize(
    ("q", "beyond"), [(1.6, False), (1.8, True), (-0.6, False), (-0.8, True)], ids=["near", "far", "low", "lower"]
)
def test_rows_are_outside_beyond_a_quarter_of_the_range_and_a_tenth_of_the_widest(q, beyond):
    """Of joints that were trained from 0 to 1 and from 0 to 4: a quarter of 1 and a tenth of 4 is .65."""
    trained = torch.tensor([[0.0, 0.0], [1.0, 4.0]])
    posterior = SimpleNamespace(joint_names=("a", "b"), training=SimpleNamespace(q=trained, v=torch.zeros(2, 2)))
    given = np.zeros((200, 2))
    given[:3, 0] = q
    assert len(list(rows_outside(posterior, Rows(given)))) == beyond
    one = np.zeros((200, 2))
    one[:1, 0] = q
    assert list(rows_outside(posterior, Rows(one))) == [], "one row of 200 is a chance"
