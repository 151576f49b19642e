"""What is learned where nobody says it: friction where there is friction, positions where forces depend on them."""

from dataclasses import replace

import numpy as np
import pytest
from tests.models.arm import arm_data, arm_system
from tests.models.test_motion_fit import bump, recording, slide

from forcegp import JointFriction, MechanicalSystem, Noise, StructuredGP
from forcegp.evaluation import allowing_for_correlation, choose_prior, usual_prior
from forcegp.mechanics import Actuation, RigidBodyBias


@pytest.fixture(scope="module")
def log():
    return recording(bump, 1)


@pytest.fixture
def bare() -> MechanicalSystem:
    return replace(slide(1.0, 1.0), known_forces=(Actuation(), RigidBodyBias()))


def test_friction_is_found_in_free_motion(log, bare):
    chosen, why = choose_prior(log, bare)
    assert chosen == "joint-friction"
    assert "joint-friction in free motion; left-out stretches of" in why
    assert "do not show joint, joint + joint-friction to be better" in why


def test_a_spring_is_no_friction(log, bare):
    spring = replace(log, u=log.u + 30.0 * np.sin(4.0 * log.q) + 3.0 * log.v)
    moved = replace(spring, a=log.a)
    chosen, why = choose_prior(moved, bare)
    assert chosen != "joint-friction"
    assert "better than joint-friction, by" in why


def test_an_identified_system_lacks_the_rest_of_its_friction(log):
    chosen, why = choose_prior(log, slide(1.0, 1.0))
    assert chosen == "joint-friction"
    assert "beside the friction laws" in why


def test_in_contact_it_is_the_tool_and_too_few_rows_are_no_look():
    system = arm_system(contacts=1)
    assert usual_prior(system) == "tool-friction"
    chosen, why = choose_prior(arm_data(2, 0, system), system)
    assert chosen == "tool-friction"
    assert "could not be compared with it" in why


def test_rows_that_resemble_each_other_are_worth_less(log, bare):
    model = StructuredGP(bare, JointFriction(), noise=Noise(0.5))
    fitted = model.fit(log, restarts=1)
    assert allowing_for_correlation(fitted, log) == (fitted, None), "white noise"
    smooth = np.convolve(np.random.default_rng(0).standard_normal(len(log) + 8), np.ones(9) / 3.0, "valid")
    slow = replace(log, a=log.a + 4.0 * smooth[:, None])
    wide, note = allowing_for_correlation(model.fit(slow, restarts=1), slow)
    k = wide.settings["correlated_rows"]
    assert 3.0 < k < 12.0, "of 9 rows that share their noise"
    assert f"over {k:.0f} rows" in note
    plain = wide.with_settings(widening=wide.widening / np.sqrt(k))
    state = log.q[:5], log.v[:5], log.u[:5]
    np.testing.assert_allclose(wide.predict(*state).covariance, k * plain.predict(*state).covariance)
    np.testing.assert_array_equal(wide.predict(*state).mean, plain.predict(*state).mean)
