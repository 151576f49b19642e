"""Estimated numbers: their intervals."""

import pytest

from forcegp.posterior.fitted import Estimate


def test_the_interval_is_that_of_student_with_19_degrees_of_freedom():
    mass = Estimate("payload.mass", "kg", 2.0, 0.5, 1.0, 1.0, "log", "")
    assert mass.interval == pytest.approx((2.0 - 0.5 * 2.09302, 2.0 + 0.5 * 2.09302), abs=1e-5)  # of tables
