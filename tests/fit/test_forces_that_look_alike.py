"""What no log tells apart is named before anything is searched for."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from tests.forces.law_conformance import STILL, log_of
from tests.posterior.arm import arm_model

from forcegp import Accelerations, Torques, fit
from forcegp.data import Dataset
from forcegp.errors import DataWarning, InvalidInput
from forcegp.forces import FORCES, Coulomb, JointForces, JointFriction, Normal, Offset, Payload, Spring, Viscous
from forcegp.inference import OptimizerOptions

QUICK = {"restarts": 1, "points": 20, "options": OptimizerOptions(iterations=3)}


@pytest.fixture(scope="module")
def log():
    return log_of(arm_model(0).with_forces(Viscous(0.3), Coulomb(0.2, 0.2)))


@pytest.mark.parametrize(
    ("law", "unknown", "named"),
    [
        (Viscous(), JointFriction(), "gp:joint-friction can be what viscous is"),
        (Coulomb(), JointFriction(), "gp:joint-friction can be what coulomb is"),
        (Offset(), JointFriction(), "gp:joint-friction can be what offset is"),
        (Spring(), JointForces(("q",)), "gp:joint-forces can be what spring is"),
    ],
    ids=lambda each: getattr(each, "title", None),
)
def test_a_law_that_an_unknown_force_can_be_is_named(log, law, unknown, named):
    with pytest.warns(DataWarning, match=f"{named}.* leave gp:.* out"):
        fit(arm_model(0).with_forces(law, unknown, noise=STILL), log, Accelerations(), **QUICK)


@pytest.mark.parametrize(("law", "unknown"), [(Spring(), JointFriction()), (Viscous(), JointFriction(("bend",)))])
def test_no_word_where_it_is_another_force(log, law, unknown, recwarn):
    known = law if isinstance(law, Spring) else Viscous(Normal([0.1, 0.1, 0.1], [1.0, 1.0, 0.0]))
    fit(arm_model(0).with_forces(known, unknown, noise=STILL), log, Accelerations(), **QUICK)
    assert not [each for each in recwarn if "can be what" in str(each.message)]


def test_the_same_law_twice_and_two_payloads(log):
    model = arm_model(0)
    with pytest.raises(InvalidInput, match="'viscous' twice"):
        fit(replace(model, forces=(*model.forces, Viscous(), Viscous())), log)
    with pytest.raises(InvalidInput, match="two payloads on one body"):
        fit(model.with_forces(Payload("hand"), Payload("hand")), log)


def test_laws_that_are_the_same_in_these_rows(log, monkeypatch):
    @dataclass(frozen=True, eq=False)
    class Damper(Viscous):
        """Another name for the same."""

    monkeypatch.setitem(FORCES, "damper", Damper)
    with pytest.warns(
        DataWarning, match=r"viscous.pan and damper.pan, viscous.lift and damper.lift.* are the same force in every row"
    ):
        fit(arm_model(0).with_forces(Viscous(), Damper()), log, Torques())


def test_an_offset_that_can_carry_the_weight_on_a_contact():
    model = arm_model(1)
    log = log_of(model, 40)
    idle = replace(log, u=log.u * [1.0, 0.0, 1.0])
    with pytest.raises(InvalidInput, match="nothing drives lift, so an offset there can carry the weight"):
        fit(model.with_forces(Offset(), JointForces(("q",))), idle, Accelerations(), **QUICK)


def test_a_number_that_no_row_shows(log):
    still = replace(log, v=log.v * [1.0, 0.0, 1.0])
    with pytest.warns(DataWarning, match="no row shows viscous.lift, so each stays at its prior"):
        found = fit(arm_model(0).with_forces(Viscous()), still)
    assert found.parameters["viscous.lift"].decided_by == "prior"


def test_rows_that_are_equal_count_once(log):
    columns = {name: np.repeat(getattr(log, name), 2, axis=0) for name in "qvua"}
    twice = Dataset(**columns, time=0.01 * np.arange(2 * len(log)), model=log.model)
    with pytest.warns(DataWarning, match="200 of 400 rows equal another one and count once"):
        found = fit(arm_model(0).with_forces(Viscous()), twice)
    alone = fit(arm_model(0).with_forces(Viscous()), log)
    assert found.parameters["viscous.pan"].std == pytest.approx(alone.parameters["viscous.pan"].std, rel=1e-6)
