"""The prior on unconstrained accelerations, and no unknown force at all, against the formulas that they stand for."""

import math

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data

from forcegp.errors import InvalidInput
from forcegp.fit import fit
from forcegp.forces import JointAccelerations, JointForces
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise

QUICK = OptimizerOptions(iterations=10)


@pytest.fixture(scope="module")
def train():
    return arm_data(30, 1)


@pytest.fixture(scope="module")
def test():
    return arm_data(20, 2)


def test_accelerations_are_mixed_by_the_projection_onto_the_constraint(train):
    dynamics = train.model.dynamics(*[torch.tensor(x) for x in (train.q, train.v, train.u)])
    W, M, A = dynamics.H @ JointAccelerations().direction(dynamics), dynamics.M.numpy(), dynamics.A.numpy()
    M_inverse = np.linalg.inv(M)
    projector = np.eye(3) - M_inverse @ A.transpose(0, 2, 1) @ np.linalg.inv(A @ M_inverse @ A.transpose(0, 2, 1)) @ A
    assert np.allclose(W.numpy(), projector, atol=1e-12)
    assert np.allclose(projector @ projector, projector, atol=1e-10)


def test_without_forces_the_prediction_is_the_analytical_model(train, test):
    prediction = fit(train.model, train).predict(test.q, test.v, test.u)
    dynamics = train.model.dynamics(*(torch.tensor(x) for x in (test.q, test.v, test.u)))
    assert torch.allclose(prediction.mean, dynamics.acceleration_map().offset, atol=1e-12)
    assert prediction.covariance is not None
    assert bool((prediction.covariance == 0).all())


def test_without_forces_learned_noise_is_the_mean_square_residual(train):
    states = [torch.tensor(x) for x in (train.q, train.v, train.u)]
    residual = torch.tensor(train.a) - train.model.dynamics(*states).acceleration_map().offset
    expected = residual.square().mean(0).sqrt()  # about which its prior is, too
    posterior = fit(train.model.with_forces(noise=Noise(tuple(expected.tolist()), learn=True)), train)
    assert torch.allclose(posterior.noise_std, expected, rtol=1e-4)
    likelihood = torch.distributions.Normal(0.0, posterior.noise_std).log_prob(residual).sum()
    assert posterior.negative_log_likelihood == pytest.approx(-float(likelihood), rel=1e-10)


def test_a_search_begins_where_it_is_told(train):
    model = train.model.with_forces(JointForces())
    long = fit(model, train, points=20, restarts=1, options=OptimizerOptions(iterations=60))
    again = fit(model, train, points=20, restarts=1, start=long.hyperparameters, options=OptimizerOptions(iterations=1))
    assert again.result.history[0] == pytest.approx(long.result.value, rel=1e-10)
    more = fit(model, train, start=long.hyperparameters, restarts=1, options=OptimizerOptions(iterations=1))
    fresh = fit(model, train, restarts=1, options=OptimizerOptions(iterations=1))
    assert more.result.history[0] < fresh.result.history[0]
    assert math.isfinite(more.result.value)


def test_a_start_with_other_parameters_is_refused(train):
    model = train.model.with_forces(JointForces())
    with pytest.raises(InvalidInput, match="start has 'magic'"):
        fit(model, train, start={"magic": torch.ones(1).double()}, options=QUICK)
    name = "kernels.0.raw_outputscale"
    with pytest.raises(InvalidInput, match=r"start\['kernels.0.raw_outputscale'\]"):
        fit(model, train, start={name: torch.ones(3).double()}, options=QUICK)
