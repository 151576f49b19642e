"""Noise about systems that were identified without the rows in question."""

from dataclasses import replace

import numpy as np
import pytest
from tests.posterior.arm import NOISE, arm_data, arm_model

from forcegp.errors import InvalidInput
from forcegp.evidence import Accelerations
from forcegp.fit import held_out_noise
from forcegp.fit.physical import _left_out
from forcegp.forces import Coulomb, RigidBodies, Viscous

LAWS = Viscous(), Coulomb()


def data(rows: int = 120):
    model = arm_model(0, baumgarte=None)
    return model, arm_data(rows, 1, model)


def test_of_a_system_that_fits_it_is_the_noise_of_the_measurement():
    model, rows = data(240)
    found = held_out_noise(model.with_forces(*LAWS), rows, Accelerations())
    np.testing.assert_allclose(found.acceleration, NOISE, rtol=0.6)
    assert (np.array(found.force) < 0.1).all()


def test_what_the_system_lacks_counts_as_noise():
    model, rows = data()
    lacking = held_out_noise(model.with_forces(RigidBodies(("hand",))), rows, Accelerations())
    whole = held_out_noise(model.with_forces(*LAWS), rows, Accelerations())
    assert (np.array(lacking.force) > 3.0 * np.array(whole.force)).all()


def test_episodes_are_left_out_whole():
    model, rows = data()
    model = model.with_forces(*LAWS)
    one = held_out_noise(model, rows, Accelerations())
    three = held_out_noise(model, replace(rows, episode=np.repeat([3, 1, 2], 40)), Accelerations())
    assert not np.array_equal(one.acceleration, three.acceleration)
    left = [_left_out(replace(rows, episode=np.arange(120) // length)) for length in (24, 10)]
    assert (len(left[0]), np.unique(left[1][1] // 10).tolist()) == (5, [1, 7]), "of twelve pieces two at once"


def test_refusals():
    model, rows = data(20)
    with pytest.raises(InvalidInput, match="has 5 rows"):
        held_out_noise(model.with_forces(*LAWS), rows.rows(slice(5)), Accelerations())
