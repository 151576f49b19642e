"""What stands beside the scores of a model, so that nobody has to find it out."""

import dataclasses
import warnings

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from tests.posterior.arm import NOISE, arm_data

from forcegp import score
from forcegp.errors import DataWarning
from forcegp.fit import fit
from forcegp.forces import JointForces, JointFriction
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise
from forcegp.scores import predict_rows, unfinished_search

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
    there = dataclasses.replace(data, a=a, truth={"a": a})
    found = scored(friction, there)
    (sentence,) = about(found.warnings, "worse here than its known forces alone")
    assert f"noise-free MAE {found.value('mae', TRUE):.3g} against 0" in sentence


def test_intervals_that_miss_are_named(friction):
    """Measurements five times as noisy as is stated."""
    data = arm_data(60, 1)
    noisy = dataclasses.replace(data, a=data.a + 5.0 * NOISE * np.random.default_rng(0).normal(size=data.a.shape))
    found = scored(friction, noisy)
    assert found.value("coverage_95") < 0.8
    (sentence,) = about(found.warnings, "95 % intervals")
    assert f"hold {found.value('coverage_95'):.0%} of the measurements" in sentence


def test_a_joint_that_hides_in_the_mean_is_named(friction):
    """One joint lacks the friction that was learned, and another is as noisy as five times what is stated."""
    data = arm_data(200, 1)
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]
    known = data.model.dynamics(*states).acceleration_map().offset.numpy()
    a, measured = data.truth["a"].copy(), data.a.copy()
    a[:, 0] = known[:, 0]
    measured[:, 0] = known[:, 0] + (data.a - data.truth["a"])[:, 0]
    names = data.joint_names
    found = scored(friction, dataclasses.replace(data, a=measured, truth={"a": a}))
    assert found.value("mae", TRUE) < found.value("known_physics_mae", TRUE)
    (sentence,) = about(found.warnings, "worse here than")
    assert f"at 1 of {len(names)} joints, {names[0]} " in sentence
    noisy = data.a.copy()
    noisy[:, 2] += 2.0 * NOISE * np.random.default_rng(0).normal(size=len(noisy))
    found = scored(friction, dataclasses.replace(data, a=noisy))
    assert found.value("coverage_95") > 0.85
    (sentence,) = about(found.warnings, "95 % intervals")
    assert f"of the measurements ({names[2]} {found.columns('coverage_95')[2]:.0%}):" in sentence


def test_noise_that_nobody_stated_is_learned_and_said_so():
    data = dataclasses.replace(arm_data(60, 0), noise_std=None)
    model = data.model.with_forces(JointFriction())
    with pytest.warns(DataWarning, match="does not state the noise of its accelerations, so it is learned.*`noise`"):
        posterior = fit(model, data, **QUICK)
    assert posterior.model.noise.learn
    np.testing.assert_allclose(posterior.noise_std.numpy(), NOISE, rtol=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        asked = fit(dataclasses.replace(model, noise=Noise(None, learn=True)), data, **QUICK)
    torch.testing.assert_close(asked.noise_std, posterior.noise_std)


# ---------------------------------------------------------------- rows, noise and contacts that differ


def test_a_larger_noise_of_the_data_counts(posterior, test_data):
    std = NOISE * np.array([1.0, 1.4, 3.0])  # the model's is NOISE
    noisier = dataclasses.replace(test_data, noise_std=std)
    predicted = predict_rows(posterior, noisier)
    np.testing.assert_allclose(predicted.measurement_variance - predicted.variance, np.tile(std**2, (60, 1)), rtol=1e-9)
    prediction = posterior.predict(test_data.q[7], test_data.v[7], test_data.u[7])
    joint = multivariate_normal(prediction.mean.numpy(), prediction.covariance.numpy() + np.diag(std**2))
    assert predicted.negative_log_density[7] == pytest.approx(-joint.logpdf(test_data.a[7]), rel=1e-8)


@pytest.mark.parametrize(("stated", "counts"), [((0.1, 2.0, 0.5), (1.0, 2.0, 1.0)), (None, (1.0, 1.0, 1.0))])
def test_a_larger_noise_of_the_model_counts(posterior, test_data, stated, counts):
    quieter = dataclasses.replace(test_data, noise_std=None if stated is None else NOISE * np.array(stated))
    predicted = predict_rows(posterior, quieter)
    added = predicted.measurement_variance - predicted.variance
    np.testing.assert_allclose(added, np.tile(np.square(NOISE * np.array(counts)), (60, 1)), rtol=1e-9)


def test_the_constraint_is_that_of_the_data_and_a_model_without_it_is_named(without_contact, test_data):
    found = scored(without_contact, test_data)
    assert found.value("mae", "constraint") > 1e-3
    assert about(found.warnings, "contacts of the model are not those of the data")
    assert "contact force" not in found.quantities()


def test_rows_and_recordings_that_were_trained_on_are_named(posterior, train, test_data):
    mixed = {name: np.vstack([getattr(test_data, name)[:-2], getattr(train, name)[:2]]) for name in "qvua"}
    (warning,) = about(scored(posterior, dataclasses.replace(test_data, **mixed)).warnings, "training rows")
    assert "2 of 60 test rows have the very (q, v, u) of training rows (the first: row 58)" in warning
    recorded = posterior.with_settings(data={"metadata": {"log": "monday"}, "episodes": [0]})
    same = dataclasses.replace(test_data, metadata={"log": "monday"})
    assert len(about(scored(recorded, same).warnings, "same recording")) == 1
    tuesday = dataclasses.replace(test_data, metadata={"log": "tuesday"})
    elsewhere = dataclasses.replace(same, episode=np.ones(60, int))
    assert [about(scored(recorded, other).warnings, "same recording") for other in (tuesday, elsewhere)] == [[], []]
