"""`posterior.leave_out`: against Gaussian conditioning of the model's own marginal likelihood, and end to end."""

import dataclasses

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data, arm_model

from forcegp.data import time_blocks
from forcegp.fit import fit
from forcegp.forces import JointAccelerations, JointForces
from forcegp.inference import OptimizerOptions, negative_log_likelihood
from forcegp.noise import Noise

QUICK = OptimizerOptions(iterations=15)
BLOCKS = [[0, 5, 7], [2], [11, 3]]


@pytest.fixture(scope="module")
def train():
    data = arm_data(16, seed=1)
    return dataclasses.replace(data, noise_std=0.05 * np.linspace(0.5, 2.0, 48).reshape(16, 3))


MODELS = {
    "forces": lambda model: model.with_forces(JointForces()),
    "noise of forces": lambda model: model.with_forces(JointForces(), noise=Noise(None, 0.05, learn=True)),
    "zero mean": lambda model: model.with_forces(JointForces()).without_mean(),
    "accelerations": lambda model: model.with_forces(JointAccelerations()).without_mean(),
    "no forces": lambda model: model,
    "independent": lambda model: model.black_box(),
}


def log_likelihood_without(posterior, rows):
    """Of the other rows, from the marginal likelihood of the model itself at the same parameters and features."""
    likelihood = posterior.likelihood
    keep = [row for row in range(16) if row not in rows]
    features, W, residual, noise = likelihood.terms(posterior.hyperparameters)
    matrices = posterior.kernels.matrices(posterior.hyperparameters, [z[keep] for z in features])
    return -float(negative_log_likelihood(W[keep], residual[keep], noise[keep], matrices))


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
def test_a_block_is_the_likelihood_of_all_rows_less_that_of_the_others(make, train):
    posterior = fit(make(train.model), train, restarts=1, options=QUICK)
    found = posterior.leave_out(BLOCKS)
    with torch.no_grad():
        for block, density in zip(BLOCKS, found.log_density, strict=True):
            expected = -posterior.negative_log_likelihood - log_likelihood_without(posterior, block)
            assert float(density) == pytest.approx(expected, rel=1e-6, abs=1e-5)
    single = posterior.leave_out()
    assert single.rows.tolist() == list(range(16))
    torch.testing.assert_close(single.per_row, single.log_density, rtol=1e-9, atol=1e-9)
    assert single.total == pytest.approx(float(single.log_density.sum()))
    assert single.residual.shape == (16, 3)
    assert single.covariance.shape == (16, 3, 3)
    alone = posterior.leave_out([[4]])
    torch.testing.assert_close(alone.residual[0], single.residual[4], rtol=1e-9, atol=1e-9)


def test_what_is_left_out_is_predicted_as_well_as_new_rows_are():
    """Leave-one-out residuals are test residuals: as large and as likely, and inside their intervals."""
    train, test = arm_data(60, seed=3), arm_data(300, seed=4)
    posterior = fit(train.model.with_forces(JointForces()), train, restarts=1, options=OptimizerOptions(iterations=40))
    found = posterior.leave_out()
    prediction = posterior.predict(test.q, test.v, test.u)
    new = torch.tensor(test.a) - prediction.mean
    assert float(found.residual.abs().median()) == pytest.approx(float(new.abs().median()), rel=0.3)
    normal = torch.distributions.MultivariateNormal(torch.zeros_like(new), prediction.measurement.covariance)
    assert found.total / 60 == pytest.approx(float(normal.log_prob(new).mean()), abs=0.3)
    std = found.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert 0.88 < float((found.residual.abs() < 1.96 * std).double().mean()) < 0.995


def test_rows_beside_each_other_in_time_flatter_a_model_that_only_remembers():
    """A slow motion, every row of which has neighbours nearly equal to it: left out alone it is known all the same."""
    data = arm_data(40, seed=5, model=arm_model(0))
    path = np.linspace(0.0, 1.0, 40)[:, None]
    q, v, u = (first[:1] + path * (first[1:2] - first[:1]) for first in (data.q, data.v, data.u))
    dynamics = data.model.dynamics(*map(torch.tensor, (q, v, u)))
    a = dynamics.acceleration(torch.tensor(-np.tanh(v / 0.4))).numpy()
    a = a + np.random.default_rng(0).normal(0.0, 0.05, a.shape)
    slow = dataclasses.replace(data, q=q, v=v, u=u, a=a, truth={})
    posterior = fit(slow.model.black_box(), slow, restarts=1, options=QUICK)
    blocks = time_blocks(slow.time, slow.episode, 0.2)
    assert len(blocks) == 2
    assert posterior.leave_out(blocks).total < posterior.leave_out().total
