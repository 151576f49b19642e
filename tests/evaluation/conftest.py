"""One small fitted arm for all tests of this package."""

import pytest
from tests.models.arm import arm_data, arm_system

from forcegp.data import Dataset
from forcegp.inference import OptimizerOptions
from forcegp.models import StructuredGP, StructuredPosterior


@pytest.fixture(scope="session")
def train() -> Dataset:
    return arm_data(30, seed=0)


@pytest.fixture(scope="session")
def test_data() -> Dataset:
    return arm_data(60, seed=1)


@pytest.fixture(scope="session")
def posterior(train) -> StructuredPosterior:
    return StructuredGP(arm_system()).fit(train, restarts=1, options=OptimizerOptions(iterations=30))


@pytest.fixture(scope="session")
def without_mean(train) -> StructuredPosterior:
    return StructuredGP(arm_system(), mean="zero").fit(train, restarts=1, options=OptimizerOptions(iterations=30))


@pytest.fixture(scope="session")
def without_contact(train) -> StructuredPosterior:
    model = StructuredGP(arm_system(contacts=0))
    return model.fit(train, restarts=1, options=OptimizerOptions(iterations=3))
