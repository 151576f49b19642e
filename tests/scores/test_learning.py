"""What is learned where nobody says it: friction where there is friction, positions where forces depend on them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.fit.test_motion_fit import bump, line, recording, slide
from tests.forces.test_thrusters import DRONE
from tests.posterior.arm import arm_data, arm_model
from tests.robots.test_moving_bases import LIMBS

from forcegp import Coulomb, JointFriction, Model, Noise, fit
from forcegp.data import with_memory
from forcegp.errors import InvalidInput
from forcegp.evidence import Motions, Torques
from forcegp.forces import Actuation, RigidBodies, Thrusters
from forcegp.mechanics import fixed_point
from forcegp.noise import ACCELERATION
from forcegp.posterior import load_posterior, save_posterior
from forcegp.progress import watched
from forcegp.robots import Robot
from forcegp.scores import models, named_model, summands, usual_forces


@pytest.fixture
def bare() -> Model:
    return replace(slide(1.0, 1.0), forces=(Actuation(), RigidBodies()))


def test_robots_that_fly_have_air_and_feet_that_stand_do_not_slide():
    rotors = Actuation(), Thrusters("body", ((0.2, 0.0, 0.0), (-0.1, 0.2, 0.0), (-0.1, -0.2, 0.0))), RigidBodies()
    robots = [Robot.from_urdf_text(DRONE, base="floating", locked=locked) for locked in ({"tilt": 0.0}, {})]
    drones = [Model(robot, (), rotors) for robot in robots]
    walker = Model(Robot.from_urdf_text(LIMBS, base="floating"), fixed_point("a_foot", switch="a_stands"))
    systems = *drones, walker, Model(robots[0], (), (RigidBodies(),))
    assert usual_forces(arm_model(contacts=1)) == "gp:tool-friction"
    found = [usual_forces(model) for model in systems]
    assert found == ["gp:aerodynamic", "gp:joint-friction+gp:aerodynamic", "gp:joint-friction", "gp:joint"]
    for model, name in zip(systems, found, strict=True):
        named_model(model, summands(name))
        assert "given" in models.candidates(models.default_models(model), model, models.usual_identification(model))
    with pytest.raises(InvalidInput, match="none but its base; leave it out"):
        named_model(drones[0], ("gp:aerodynamic", "gp:joint-friction"))


def test_rows_that_resemble_each_other_are_worth_less(bare, tmp_path):
    log, model = recording(bump, 1, seconds=6.0), bare.with_forces(JointFriction(), noise=Noise(0.5))
    fitted = fit(model, log, restarts=1)
    assert models.allowing_for_correlation(fitted, log) == (fitted, None), "white noise"
    smooth = np.convolve(np.random.default_rng(0).standard_normal(len(log) + 8), np.ones(9) / 3.0, "valid")
    slow = replace(log, a=log.a + 4.0 * smooth[:, None])
    wide, note = models.allowing_for_correlation(fit(model, slow, restarts=1), slow)
    k = wide.settings["correlated_rows"]
    assert 2.0 < k < 12.0, "of 9 rows that share their noise"
    assert f"over {k:.0f} rows" in note
    # nine rows that share their noise are one: the posterior of rows that are noisier by the root of k
    noisier = {**wide.hyperparameters, ACCELERATION: wide.hyperparameters[ACCELERATION] + 0.5 * np.log(k)}
    given = wide.training, noisier, wide.result, {"widening": wide.widening}, wide.engine
    expected = wide.conditioned(replace(wide.trained, noise=model.noise), *given)
    state = log.q[:5], log.v[:5], log.u[:5]
    np.testing.assert_allclose(wide.predict(*state).mean, expected.predict(*state).mean, rtol=1e-12)
    np.testing.assert_allclose(wide.predict(*state).covariance, expected.predict(*state).covariance, rtol=1e-12)
    np.testing.assert_allclose(wide.noise_std, [0.5], rtol=1e-12)
    save_posterior(wide, tmp_path / "run")
    again = load_posterior(tmp_path / "run")
    np.testing.assert_array_equal(again.predict(*state).covariance, wide.predict(*state).covariance)


def test_the_past_of_friction_need_not_be_in_u():
    """A plain log and one with columns of what friction remembers give the same noise of forces."""
    model = arm_model(contacts=0, baumgarte=None).with_forces(JointFriction())
    remembers = Coulomb(2.0, 0.05, sigma=50.0, memory=True)
    model = replace(model, forces=(*model.forces, remembers), noise=Noise(0.1, learn=True))
    log = replace(arm_data(60, 0, arm_model(contacts=0, baumgarte=None)), time=0.01 * np.arange(60))
    plain, complete = (models.with_force_noise(model, rows).noise.force for rows in (log, with_memory(log, model)))
    assert plain == complete


def test_noise_of_forces_is_learned_where_rows_show_it():
    model = arm_model(contacts=0, baumgarte=None)
    data = arm_data(60, 0, model)
    for noise in (None, Noise(0.1), Noise(0.1, 0.2, learn=True)):
        model = replace(arm_model(contacts=0, baumgarte=None).with_forces(JointFriction()), noise=noise)
        assert models.with_force_noise(model, data) is model, "stated, or already there"
    model = models.with_force_noise(replace(model, noise=Noise(0.1, learn=True)), data)
    q, v, a = (torch.tensor(x) for x in (data.q, data.v, data.a))
    lacking = model.robot.inverse_dynamics(q, v, a).numpy() - data.u
    np.testing.assert_allclose(model.noise.force, lacking.std(axis=0, ddof=1), rtol=1e-8)


@pytest.mark.nightly
def test_laws_are_refined_on_motions_and_a_short_log_says_how_far_intervals_are_calibrated():
    recorded = recording(line, 1, seconds=3.0)
    model, told = replace(slide(1.0, 1.0), forces=(Actuation(), RigidBodies())), []
    with watched(lambda *words: told.append(words[:2])):
        posterior, notes = models.learn(named_model(model, ("viscous", "coulomb")), recorded, [Torques(), Motions(0.5)])
    assert posterior.settings["motions"]["seconds"] == 0.5
    assert posterior.parameters["viscous.x"].value == pytest.approx(3.0, rel=0.2)
    assert told
    assert notes == ["intervals of motions are measured up to 0.5 s"]
    same, why = models.with_intervals_of_motions(posterior, recorded.rows(slice(20)))
    assert same is posterior
    assert why.startswith("intervals of motions are not calibrated: ")
    with pytest.raises(InvalidInput, match="the model has unknown forces"):
        models.learn(model.black_box(), recorded, [Motions(0.5)])
