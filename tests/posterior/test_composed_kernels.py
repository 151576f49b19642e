"""Kernels other than the squared exponential all the way through: fit, store, predict, roll out drawn functions."""

import pytest
import torch
from tests.posterior.arm import NOISE, arm_data

from forcegp import fit
from forcegp.forces import JointForces, JointFriction
from forcegp.inference import OptimizerOptions
from forcegp.posterior.storage import load_posterior, save_posterior

PRIORS = {
    "a sum": JointForces(kernel="linear + matern-5/2"),
    "a product": JointForces(("q", "v"), kernel="rational-quadratic * (constant + linear)"),
    "friction": JointFriction(),
}


@pytest.mark.parametrize("prior", PRIORS.values(), ids=PRIORS)
def test_fit_store_predict_and_roll_out(prior, tmp_path):
    data = arm_data(24, 0)
    model = data.model.with_forces(prior, noise=NOISE)
    posterior = fit(model, data, restarts=2, options=OptimizerOptions(iterations=8))
    assert posterior.result.value < posterior.result.history[0] or posterior.result.converged
    save_posterior(posterior, tmp_path / "model")
    again = load_posterior(tmp_path / "model")
    state = [torch.tensor(x[:3]) for x in (data.q, data.v, data.u)]
    expected, found = posterior.predict(*state), again.predict(*state)
    assert torch.equal(expected.mean, found.mean)
    assert torch.equal(expected.covariance, found.covariance)
    start = [x[0] for x in state[:2]]
    u = state[2][:1].expand(5, -1)
    motions = [fitted.rollout(*start, u, 0.01, samples=3, seed=1) for fitted in (posterior, again)]
    assert bool(torch.isfinite(motions[0].samples.q).all())
    assert torch.equal(motions[0].samples.q, motions[1].samples.q)
