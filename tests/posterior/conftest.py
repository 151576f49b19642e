"""Fixtures of several tests of predictors."""

import pytest
import torch
from tests.posterior.arm import arm_data, arm_model, quick_fit

from forcegp.forces import JointForces
from forcegp.posterior import Posterior


@pytest.fixture(scope="module")
def states() -> tuple[torch.Tensor, ...]:
    data = arm_data(5, 1)
    return tuple(torch.tensor(x) for x in (data.q, data.v, data.u))


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    return quick_fit(arm_model().with_forces(JointForces()))
