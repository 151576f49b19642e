"""What stands beside the scores of a model, so that nobody has to find it out."""

import dataclasses
import warnings

import numpy as np
import pytest
import torch
from tests.posterior.arm import NOISE, arm_data, arm_model

from forcegp.errors import DataWarning
from forcegp.evaluation import evaluate, unfinished_search
from forcegp.fit import fit
from forcegp.forces import JointForces, JointFriction
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise

QUICK = {"restarts": 1, "options": OptimizerOptions()}


@pytest.fixture(scope="module")
def friction():
    data = arm_data(40, 0)
    return fit(data.model.with_forces(JointFriction()), data, **QUICK)


def about(warnings, topic) -> list[str]:
    return [warning for warning in warnings if topic in warning]


def test_of_a_good_model_nothing_is_said(friction):
    assert friction.result.converged
    assert evaluate(friction, arm_data(60, 1)).warnings == ()


def test_a_search_that_did_not_end_is_named():
    data = arm_data(20, 0)
    posterior = fit(data.model.with_forces(JointForces()), data, restarts=1, options=OptimizerOptions(iterations=2))
    (sentence,) = unfinished_search(posterior)
    assert "did not converge (stopped at the limit of 2 iterations" in sentence
    assert about(evaluate(posterior, arm_data(20, 1)).warnings, "did not converge") == [sentence]


def test_rows_outside_of_the_training_range_are_named_with_the_worst_joint(friction):
    data = arm_data(60, 1)
    v = data.v.copy()
    v[:6, 1] += 9.0
    (sentence,) = about(evaluate(friction, dataclasses.replace(data, v=v)).warnings, "outside")
    assert sentence.startswith("10% of the rows lie outside of the range that the model was trained in")
    assert "(worst: v of lift is" in sentence


def test_a_model_that_is_worse_than_its_known_forces_is_named(friction):
    """Without the friction that it has learned: u holds it already."""
    data = arm_data(60, 1)
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]
    a = data.model.dynamics(*states).acceleration_map().offset.numpy()
    there = dataclasses.replace(data, a=a, truth={"a": a})
    found = evaluate(friction, there)
    (sentence,) = about(found.warnings, "worse here than its known forces alone")
    assert f"noise-free MAE {found.mae_noise_free:.3g} against 0" in sentence


def test_intervals_that_miss_are_named(friction):
    """Measurements five times as noisy as is stated."""
    data = arm_data(60, 1)
    noisy = dataclasses.replace(data, a=data.a + 5.0 * NOISE * np.random.default_rng(0).normal(size=data.a.shape))
    found = evaluate(friction, noisy)
    assert found.coverage_95 < 0.8
    (sentence,) = about(found.warnings, "95 % intervals")
    assert f"hold {found.coverage_95:.0%} of the measurements" in sentence


def test_a_joint_that_hides_in_the_mean_is_named(friction):
    """One joint lacks the friction that was learned, and another is as noisy as five times what is stated."""
    data = arm_data(200, 1)
    states = [torch.tensor(x) for x in (data.q, data.v, data.u)]
    known = data.model.dynamics(*states).acceleration_map().offset.numpy()
    a, measured = data.truth["a"].copy(), data.a.copy()
    a[:, 0] = known[:, 0]
    measured[:, 0] = known[:, 0] + (data.a - data.truth["a"])[:, 0]
    names = data.joint_names
    found = evaluate(friction, dataclasses.replace(data, a=measured, truth={"a": a}))
    assert found.mae_noise_free < found.known_physics_mae_noise_free
    (sentence,) = about(found.warnings, "worse at")
    assert f"worse at 1 of {len(names)} joints (noise-free MAE: {names[0]} " in sentence
    noisy = data.a.copy()
    noisy[:, 2] += 2.0 * NOISE * np.random.default_rng(0).normal(size=len(noisy))
    found = evaluate(friction, dataclasses.replace(data, a=noisy))
    assert found.coverage_95 > 0.85
    (sentence,) = about(found.warnings, "95 % intervals")
    assert f"of the measurements ({names[2]} {found.coverage_95_per_joint[2]:.0%}):" in sentence


@pytest.mark.parametrize("identified", [True, False])
def test_another_robot_is_advised_only_where_the_rows_bear_it_out(identified):
    """The advice to take the robot of the data turned an error of .28 into 25 where the model's own was identified."""
    true = arm_model().with_robot(arm_model().robot.with_armature(torch.tensor([0.4, 0.4, 0.4])))
    data = {seed: arm_data(40, seed, true) for seed in (0, 1)}
    mine, theirs = (true, arm_model()) if identified else (arm_model(), true)
    train = dataclasses.replace(data[0], model=mine)
    posterior = fit(mine.with_forces(JointFriction()), train, **QUICK)
    test = dataclasses.replace(data[1], model=theirs)
    sentences = about(evaluate(posterior, test).warnings, "robot of the model is not that of the data")
    kept, moved = (evaluate(model, test).mae for model in (posterior, posterior.with_model(theirs)))
    if identified:
        assert moved > 2.0 * kept
        assert sentences == []
    else:
        (sentence,) = sentences
        assert "`posterior.with_model(dataset.model)`" in sentence
        assert f"{moved:.3g} instead of {kept:.3g}" in sentence


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
