"""What air does: sought where u has the model's columns, and observed where rows have a past."""

import numpy as np
import pytest
from tests.data.test_wind import flight

from forcegp.errors import InvalidInput
from forcegp.forces import AerodynamicForce
from forcegp.posterior.observed_wrench import _with_past, in_air


def test_wind_is_sought_where_inputs_are_those_of_the_model():
    rows = flight([(3.0, -2.0, 0.0)])
    model = rows.model.with_forces(AerodynamicForce())
    settings, seen = in_air(model, rows)
    np.testing.assert_allclose(settings["air"]["wind"], (3.0, -2.0, 0.0), atol=1e-5)
    assert len(seen.model.inputs) == len(model.inputs) + 3


def test_rows_without_a_past_are_left_out_and_refused_where_all_are():
    rows = flight([(0.0, 0.0, 0.0)] * 2, episodes=2, rows=30)
    assert _with_past(rows, 0.105).tolist() == [*range(11, 30), *range(41, 60)]
    with pytest.raises(InvalidInput, match=r"less than 1 s of flight.*give longer pieces"):
        _with_past(rows, 1.0)
