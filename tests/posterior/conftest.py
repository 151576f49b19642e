"""Fixtures of several tests of predictors."""

import pytest
import torch
from tests.posterior.arm import arm_data


@pytest.fixture(scope="module")
def states() -> tuple[torch.Tensor, ...]:
    """q, v and u of five states."""
    data = arm_data(5, 1)
    return tuple(torch.tensor(x) for x in (data.q, data.v, data.u))
