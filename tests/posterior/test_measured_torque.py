"""Predictions from measured torques against Bayes' rule written out, along contacts, in rollouts and in files."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.posterior.arm import arm_data, arm_model

from forcegp.errors import InvalidInput
from forcegp.fit import fit
from forcegp.forces import JointFriction
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise
from forcegp.posterior import load_posterior, save_posterior

FORCE = (0.4, 0.5, 0.6)


def fitted(prior, contacts: int = 0, *, measured_torque: bool = True):
    model = arm_model(contacts, **({} if contacts else {"baumgarte": None}))
    model = model.with_forces(prior, noise=Noise(0.05, FORCE, measured_torque=measured_torque))
    data = arm_data(30, 1, model)
    return fit(model, data, restarts=1, options=OptimizerOptions(iterations=5)), arm_data(6, 2, model)


def predicted(posterior, rows):
    return posterior.predict(rows.q, rows.v, rows.u)


def test_an_analytical_model_is_bayes_rule():
    """p(a | u) in proportion to N(u; M a - Q_known, F) N(a; 0, S), by precisions instead of gains."""
    posterior, rows = fitted(())
    prediction = predicted(posterior, rows)
    dynamics = posterior.dynamics(*(torch.tensor(x) for x in (rows.q, rows.v, rows.u)))
    S = torch.diag(posterior.training.a.square().mean(0))
    F = torch.diag(torch.tensor(FORCE, dtype=torch.float64) ** 2)
    covariance = torch.linalg.inv(dynamics.M @ torch.linalg.inv(F) @ dynamics.M + torch.linalg.inv(S))
    mean = (covariance @ dynamics.M @ torch.linalg.inv(F) @ dynamics.Q_K[..., None])[..., 0]
    torch.testing.assert_close(prediction.mean, mean, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(prediction.covariance, covariance, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(prediction.noise_covariance, torch.full((3,), 0.05**2).double().diag().expand(6, 3, 3))


def test_what_shrinks_is_the_prediction_under_exact_torques():
    shrunk, rows = fitted(JointFriction())
    exact = replace(shrunk, trained=replace(shrunk.model, noise=replace(shrunk.model.noise, measured_torque=False)))
    here, there = predicted(shrunk, rows), predicted(exact, rows)
    H = shrunk.dynamics(*(torch.tensor(x) for x in (rows.q, rows.v, rows.u))).H
    torque_noise = (H * torch.tensor(FORCE, dtype=torch.float64) ** 2) @ H.mT
    S = torch.diag(shrunk.training.a.square().mean(0))
    G = S @ torch.linalg.inv(torque_noise + S)
    torch.testing.assert_close(here.mean, (G @ there.mean[..., None])[..., 0], rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(here.covariance, G @ there.covariance @ G.mT + torque_noise @ G.mT, rtol=1e-7, atol=1e-9)
    assert (here.covariance.diagonal(dim1=-2, dim2=-1) > 0.0).all()


def test_rollouts_and_files_know_it(tmp_path):
    posterior, rows = fitted(JointFriction())
    motion = posterior.rollout(rows.q[0], rows.v[0], rows.u[:3], 1e-3)
    after_one_step = torch.tensor(rows.v[0]) + 1e-3 * predicted(posterior, rows.rows([0])).mean[0]
    torch.testing.assert_close(motion.v[1], after_one_step, rtol=1e-9, atol=1e-12)
    assert posterior.rollout(rows.q[0], rows.v[0], rows.u[:3], 1e-3, samples=2).q.isfinite().all()
    save_posterior(posterior, tmp_path / "model")
    again = predicted(load_posterior(tmp_path / "model"), rows)
    assert np.array_equal(again.mean, predicted(posterior, rows).mean)


def test_refusals():
    with pytest.raises(InvalidInput, match="needs the noise of the torque sensor"):
        Noise(0.1, measured_torque=True)
    posterior, _ = fitted(JointFriction())
    with pytest.raises(InvalidInput, match="for commanded torques"):
        posterior.predictor()
