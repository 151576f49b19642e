"""A double pendulum in motion, with friction learned beside a law, and an arm on a plane."""

import pytest
from tests.posterior.arm import arm_data, arm_model
from tests.simulation.pendulum import double_pendulum

from forcegp import JointForces, JointFriction, Viscous, fit, score
from forcegp.inference import OptimizerOptions
from forcegp.report import model_page, scores_sentence, scores_table

QUICK = OptimizerOptions(iterations=10)


@pytest.fixture(scope="session")
def swinging():
    return double_pendulum(4.0, seed=1)


@pytest.fixture(scope="session")
def friction(swinging):
    """Friction learned beside a viscous law of 0.1 Nm s/rad."""
    model = swinging.model
    model = type(model)(model.robot, (), forces=(*model.forces, Viscous(0.1)))
    return fit(model.with_forces(JointFriction()), swinging, points=20, restarts=1, options=QUICK)


@pytest.fixture(scope="session")
def on_plane():
    return fit(arm_model().with_forces(JointForces()), arm_data(20, seed=0), restarts=1, options=QUICK)


@pytest.fixture(scope="session")
def page(swinging, friction):
    scores = score(friction, swinging)
    return model_page(friction, swinging, title="pendulum", best=scores_sentence(scores), tables=[scores_table(scores)])
