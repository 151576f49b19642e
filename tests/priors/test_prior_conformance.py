"""Every prior, with several options, passes the suite of all priors; so does one that forcegp does not bring."""

from math import pi

import pytest
from tests.priors.prior_conformance import PriorConformance
from tests.priors.third_party_prior import AirDrag

from forcegp.priors import (
    AerodynamicForce,
    BaseWrench,
    ContactFriction,
    JointAccelerations,
    JointForces,
    JointFriction,
    NoForces,
    Payload,
    PeriodicJointForces,
    ToolForces,
)
from forcegp.priors.contact_friction import ExpectedFriction, TabulatedCurve

TIP = ("hand", (0.0, 0.0, 0.2))  # where the arm touches its plane


# random states and a fit of a few iterations: friction that was found may lift the contact without end somewhere
JAMS = pytest.mark.filterwarnings("ignore:the expected friction nearly jams")


class TestJointForces(PriorConformance):
    prior = JointForces()


class TestJointForcesOnAngles(PriorConformance):
    prior = JointForces(("q", "v"), kernel="matern-5/2", angles="sin-cos")


class TestJointAccelerations(PriorConformance):
    prior = JointAccelerations(("v",))


class TestJointFriction(PriorConformance):
    prior = JointFriction()


class TestJointFrictionOfTwoJoints(PriorConformance):
    prior = JointFriction(("bend", "pan"), kernel="linear + squared-exponential")


class TestBaseWrench(PriorConformance):
    prior = BaseWrench("hand", ("velocity", "angular-velocity", "height", "attitude"))
    acts_at = ("hand", (0.0, 0.0, 0.0))


class TestAerodynamicForce(PriorConformance):
    prior = AerodynamicForce("hand", kernel="linear")
    acts_at = ("hand", (0.0, 0.0, 0.0))


class TestToolForces(PriorConformance):
    prior = ToolForces()
    acts_at = TIP


class TestToolForcesAndTorquesOnASurface(PriorConformance):
    prior = ToolForces(torque=True, inputs=("velocity", "angular-velocity", "position"), kernel="matern-3/2")
    acts_at = TIP


class TestToolForcesAlongTheWorld(PriorConformance):
    prior = ToolForces("fore", (0.1, 0.0, -0.1), axes="world", inputs=("position", "u", "load"))
    acts_at = ("fore", (0.1, 0.0, -0.1))


class TestToolForcesAlongTheTool(PriorConformance):
    prior = ToolForces(axes="tool", torque=True, inputs=("velocity", "angular-velocity", "q"))
    acts_at = TIP


class TestContactFriction(PriorConformance):
    prior = ContactFriction()
    acts_at = TIP


@JAMS
class TestContactFrictionUnderLoad(PriorConformance):
    prior = ContactFriction(load=True)
    acts_at = TIP


class TestContactFrictionUnderExpectedLoad(PriorConformance):
    prior = ContactFriction(load=True, expected=0.3)
    acts_at = TIP


class TestContactFrictionUnderLoadWithJointFriction(PriorConformance):
    prior = ContactFriction(
        load=True,
        expected=ExpectedFriction(
            TabulatedCurve((0.0, 0.4, 1.0), (0.0, 0.2, 0.1)), (("bend", TabulatedCurve((-1.0, 1.0), (-2.0, 3.0))),)
        ),
    )
    acts_at = TIP


class TestContactFrictionOfTwoAxes(PriorConformance):
    prior = ContactFriction(axes="two-axis", load=True, kernel="linear")
    acts_at = TIP


class TestPeriodicJointForces(PriorConformance):
    prior = PeriodicJointForces()


class TestPeriodicJointForcesOfOneJoint(PriorConformance):
    prior = PeriodicJointForces(pi / 6, ("lift",))


class TestPayload(PriorConformance):
    prior = Payload("hand")
    acts_at = ("hand", (0.0, 0.0, 0.0))


class TestPayloadAtAPoint(PriorConformance):
    prior = Payload("hand", moments=False)
    acts_at = ("hand", (0.0, 0.0, 0.0))


class TestNoForces(PriorConformance):
    prior = NoForces()


class TestSum(PriorConformance):
    prior = JointFriction() + ContactFriction() + Payload("hand")


class TestSumOfTheSameKind(PriorConformance):
    prior = JointFriction(("pan",)) + JointFriction(("lift",), kernel="linear") + JointForces(("q",))


class TestAirDrag(PriorConformance):
    prior = AirDrag("hand")
    acts_at = ("hand", (0.0, 0.0, 0.0))


@JAMS
class TestSumWithAirDrag(PriorConformance):
    prior = AirDrag("hand") + ContactFriction(load=True)
