"""What no log tells apart is named before anything is searched for."""

from dataclasses import replace

import numpy as np
import pytest
from tests.forces.law_conformance import log_of
from tests.posterior.arm import arm_model

from forcegp import Accelerations, fit
from forcegp.data import Dataset
from forcegp.errors import DataWarning, InvalidInput
from forcegp.forces import Coulomb, JointForces, Offset, Payload, Viscous
from forcegp.inference import OptimizerOptions

QUICK = {"restarts": 1, "points": 20, "options": OptimizerOptions(iterations=3)}


@pytest.fixture(scope="module")
def log():
    return log_of(arm_model(0).with_forces(Viscous(0.3), Coulomb(0.2, 0.2)))


def test_the_same_law_twice_and_two_payloads(log):
    model = arm_model(0)
    with pytest.raises(InvalidInput, match="'viscous' twice"):
        fit(replace(model, forces=(*model.forces, Viscous(), Viscous())), log)
    with pytest.raises(InvalidInput, match="two payloads on one body"):
        fit(model.with_forces(Payload("hand"), Payload("hand")), log)


def test_an_offset_that_can_carry_the_weight_on_a_contact():
    model = arm_model(1)
    log = log_of(model, 40)
    idle = replace(log, u=log.u * [1.0, 0.0, 1.0])
    found = fit(model.with_forces(Offset(), JointForces(("q",)), noise=0.1), idle, Accelerations(), **QUICK)
    assert "offset.lift" not in found.parameters
    assert "offset.pan" in found.parameters


def test_a_number_that_no_row_shows(log):
    still = replace(log, v=log.v * [1.0, 0.0, 1.0])
    found = fit(arm_model(0).with_forces(Viscous()), still).parameters["viscous.lift"]
    assert (found.decided_by, found.why) == ("prior", "no row shows it")


def test_rows_that_are_equal_count_once(log):
    columns = {name: np.repeat(getattr(log, name), 2, axis=0) for name in "qvua"}
    twice = Dataset(**columns, time=0.01 * np.arange(2 * len(log)), model=log.model)
    with pytest.warns(DataWarning, match="200 of 400 rows equal another one and count once"):
        found = fit(arm_model(0).with_forces(Viscous()), twice)
    alone = fit(arm_model(0).with_forces(Viscous()), log)
    assert found.parameters["viscous.pan"].std == pytest.approx(alone.parameters["viscous.pan"].std, rel=1e-6)
