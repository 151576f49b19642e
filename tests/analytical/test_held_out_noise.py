"""Noise about systems that were identified without the rows in question."""

import numpy as np
import pytest
from tests.models.arm import NOISE, arm_data, arm_system

from forcegp.analytical import held_out_noise
from forcegp.errors import InvalidInput

HOW = {"friction": ("viscous", "coulomb"), "rotors": None, "likelihood": "acceleration"}


def data(rows: int = 120):
    system = arm_system(0, baumgarte=None)
    return system, arm_data(rows, 1, system)


def test_of_a_system_that_fits_it_is_the_noise_of_the_measurement():
    system, rows = data(240)
    found = held_out_noise(rows, system, **HOW)
    np.testing.assert_allclose(found.acceleration, NOISE, rtol=0.6)
    assert (found.force < 0.1).all()


def test_what_the_system_lacks_counts_as_noise():
    system, rows = data()
    lacking = held_out_noise(rows, system, **{**HOW, "friction": ()})
    whole = held_out_noise(rows, system, **HOW)
    assert (lacking.force > 3.0 * whole.force).all()


def test_episodes_are_left_out_whole():
    system, rows = data()
    one = held_out_noise(rows, system, **HOW)
    from dataclasses import replace

    three = held_out_noise(replace(rows, episode=np.repeat([3, 1, 2], 40)), system, **HOW)
    assert not np.array_equal(one.acceleration, three.acceleration)


def test_refusals():
    system, rows = data(20)
    with pytest.raises(InvalidInput, match="inertias='consistent'"):
        held_out_noise(rows, system, inertias="free")
    with pytest.raises(InvalidInput, match="has 5 rows"):
        held_out_noise(rows.rows(slice(5)), system, **HOW)
