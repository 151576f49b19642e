"""A double pendulum in motion, with friction learned beside a law, and an arm on a plane."""

import pytest
from tests.models.arm import arm_data, arm_system

from forcegp import JointFriction, StructuredGP, ViscousJointFriction
from forcegp.inference import OptimizerOptions
from forcegp.simulation import FreeArmConfig, simulate_free_arm

QUICK = OptimizerOptions(iterations=10)


@pytest.fixture(scope="session")
def swinging():
    return simulate_free_arm(FreeArmConfig(arm="double-pendulum", seconds=4.0, seed=1))


@pytest.fixture(scope="session")
def friction(swinging):
    """Friction learned beside a viscous law of 0.1 Nm s/rad."""
    system = swinging.system
    system = type(system)(system.robot, (), known_forces=(*system.known_forces, ViscousJointFriction(0.1)))
    return StructuredGP(system, JointFriction()).fit(swinging, points=20, restarts=1, options=QUICK)


@pytest.fixture(scope="session")
def on_plane():
    return StructuredGP(arm_system()).fit(arm_data(20, seed=0), restarts=1, options=QUICK)
