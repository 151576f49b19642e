"""Every unknown force, with several options, passes the suite of all; so does one that forcegp does not bring."""

import pytest
from tests.forces.force_conformance import UnknownConformance
from tests.forces.third_party_unknown import AirDrag

from forcegp import AerodynamicForce, ContactFriction
from forcegp.forces import JointAccelerations, JointForces, JointFriction, JointPositionForces, ToolForces
from forcegp.forces.contact_friction import ExpectedFriction, TabulatedCurve

TIP = ("hand", (0.0, 0.0, 0.2))  # where the arm touches its plane
# random states and a fit of a few iterations: friction that was found may lift the contact without end somewhere
JAMS = pytest.mark.filterwarnings("ignore:the expected friction nearly jams")


class TestJointForces(UnknownConformance):
    prior = JointForces()


class TestJointForcesOfState(UnknownConformance):
    prior = JointForces(("q", "v"), kernel="matern-5/2")


class TestJointAccelerations(UnknownConformance):
    prior = JointAccelerations(("v",))


class TestJointFriction(UnknownConformance):
    prior = JointFriction()


class TestJointFrictionOfTwoJoints(UnknownConformance):
    prior = JointFriction(("bend", "pan"), kernel="linear + squared-exponential")


class TestAerodynamicForce(UnknownConformance):
    prior = AerodynamicForce("hand", kernel="linear")
    acts_at = ("hand", (0.0, 0.0, 0.0))


class TestToolForces(UnknownConformance):
    prior, acts_at = ToolForces(), TIP


class TestToolForcesOfThePlace(UnknownConformance):
    prior, acts_at = ToolForces(inputs=("velocity", "position"), kernel="matern-3/2"), TIP


class TestContactFriction(UnknownConformance):
    prior, acts_at = ContactFriction(), TIP


@JAMS
class TestContactFrictionUnderLoad(UnknownConformance):
    prior, acts_at = ContactFriction(load=True), TIP


class TestContactFrictionUnderExpectedLoad(UnknownConformance):
    prior, acts_at = ContactFriction(load=True, expected=0.3), TIP


class TestContactFrictionUnderLoadWithJointFriction(UnknownConformance):
    prior = ContactFriction(
        load=True,
        expected=ExpectedFriction(
            TabulatedCurve((0.0, 0.4, 1.0), (0.0, 0.2, 0.1)), (("bend", TabulatedCurve((-1.0, 1.0), (-2.0, 3.0))),)
        ),
    )
    acts_at = TIP


class TestJointPositionForces(UnknownConformance):
    prior = JointPositionForces(("lift",), "matern-5/2")


class TestAirDrag(UnknownConformance):
    prior = AirDrag("hand")
    acts_at = ("hand", (0.0, 0.0, 0.0))
