"""Long-term prediction as in the paper (Rath et al. 2021, Fig. 4): the simulated arm, symplectic Euler, Baumgarte."""

import numpy as np
import pytest
import torch
from tests.posterior.arm import quick_fit

from forcegp.forces import JointForces
from forcegp.mechanics import Baumgarte
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

DT, STARTS = 1 / 240, (0, 100, 200, 300)


@pytest.fixture(scope="module")
def posterior():
    train = simulate_kuka_surface(KukaSurfaceConfig(seconds=8, seed=31))
    return quick_fit(train.model.with_forces(JointForces()), train, 30, points=60)


@pytest.fixture(scope="module")
def test():
    return simulate_kuka_surface(KukaSurfaceConfig(seconds=3, seed=32))


def a_millimetre_off(posterior, q: torch.Tensor) -> torch.Tensor:
    """The same postures with the tool 1 mm above the surface, by the smallest motion of the joints."""
    zero = torch.zeros_like(q)
    A = posterior.model.dynamics(q, zero, zero).A
    c = posterior.model.contacts[0].distance(posterior.model.robot.kinematics(q))
    return q + (torch.linalg.pinv(A) @ (1e-3 - c)[:, None, None])[..., 0]


@pytest.mark.nightly
def test_one_second_under_recorded_torques_stays_on_the_surface_and_near_the_recording(posterior, test):
    q, v = (torch.tensor(x[list(STARTS)]) for x in (test.q, test.v))
    u = torch.tensor(np.stack([test.u[k : k + 240] for k in STARTS]))
    recorded = torch.tensor(np.stack([test.q[k : k + 241] for k in STARTS]))
    off = a_millimetre_off(posterior, q)
    rollout = posterior.rollout(torch.stack([q, off]), v, u, DT, baumgarte=Baumgarte(10.0, 1.0))
    c = rollout.constraint.abs()
    assert (rollout.diverged_at == -1).all()
    assert c.max() <= 1.01e-3  # it begins 1 mm off
    assert c[0].median() <= 1.5e-4
    assert c[1, :, -1].max() <= 5e-4  # exp(-10 t) (1 + 10 t) of the start is left, and drift
    assert (rollout.q[0, :, :25] - recorded[:, :25]).abs().max() <= 5e-3
