"""One small fitted arm for all tests of this package."""

import pytest
from tests.posterior.arm import arm_data, arm_model

from forcegp.data import Dataset
from forcegp.fit import fit
from forcegp.forces import JointForces
from forcegp.inference import OptimizerOptions
from forcegp.posterior import Posterior


@pytest.fixture(scope="session")
def train() -> Dataset:
    return arm_data(30, seed=0)


@pytest.fixture(scope="session")
def test_data() -> Dataset:
    return arm_data(60, seed=1)


@pytest.fixture(scope="session")
def posterior(train) -> Posterior:
    return fit(arm_model().with_forces(JointForces()), train, restarts=1, options=OptimizerOptions(iterations=30))


@pytest.fixture(scope="session")
def without_mean(train) -> Posterior:
    return fit(
        arm_model().with_forces(JointForces()).without_mean(), train, restarts=1,
        options=OptimizerOptions(iterations=30),
    )  # fmt: skip


@pytest.fixture(scope="session")
def without_contact(train) -> Posterior:
    model = arm_model(contacts=0).with_forces(JointForces())
    return fit(model, train, restarts=1, options=OptimizerOptions(iterations=3))
