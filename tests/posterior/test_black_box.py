"""One Gaussian process per joint acceleration: the shortcut of its likelihood, against dense linear algebra."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from tests.posterior.arm import NOISE, arm_data, arm_model
from tests.posterior.model_conformance import ModelConformance
from torch.testing import assert_close

from forcegp.errors import InvalidInput
from forcegp.fit import fit
from forcegp.forces import IndependentAccelerations, JointForces
from forcegp.inference import OptimizerOptions, negative_log_likelihood
from forcegp.inference import likelihood as whole

QUICK = OptimizerOptions(iterations=15)


class TestBlackBox(ModelConformance):
    quick = {"restarts": 1, "options": QUICK}  # noqa: RUF012  # as in every suite

    @classmethod
    def make(cls, model):
        return model.black_box()


class TestJointForces(ModelConformance):
    quick = {"restarts": 1, "options": QUICK}  # noqa: RUF012  # as in every suite

    @classmethod
    def make(cls, model):
        return model.with_forces(JointForces())


def test_equals_dense_conditioning_on_a_block_diagonal_covariance():
    train, test = arm_data(60, seed=1), arm_data(5, seed=2)
    posterior = fit(train.model.black_box(), train, points=25, restarts=1, options=QUICK).with_settings(widening=1.0)
    rows = torch.cat([posterior.training.q, posterior.training.v, posterior.training.u], -1)
    shift, scale = rows.mean(0), rows.std(0, correction=0)
    z, new = (rows - shift) / scale, (torch.tensor(np.hstack([test.q, test.v, test.u])) - shift) / scale
    y, found, total = posterior.training.a, posterior.predict(test.q, test.v, test.u), 0.0
    for joint in range(3):
        length = posterior.hyperparameters[f"kernels.{joint}.base_kernel.raw_lengthscale"].exp()
        variance = posterior.hyperparameters[f"kernels.{joint}.raw_outputscale"].exp()

        def kernel(a, b, length=length, variance=variance):
            return variance * torch.exp(-0.5 * ((a[:, None] - b[None]) / length).square().sum(-1))

        S, cross = kernel(z, z) + NOISE**2 * torch.eye(25, dtype=torch.float64), kernel(new, z)
        assert_close(found.mean[:, joint], cross @ torch.linalg.solve(S, y[:, joint]))
        spread = variance - (cross * torch.linalg.solve(S, cross.mT).mT).sum(-1)
        assert_close(found.covariance[:, joint, joint], spread, rtol=1e-7, atol=1e-9)
        total -= multivariate_normal(np.zeros(25), S.numpy()).logpdf(y[:, joint].numpy())
    assert posterior.negative_log_likelihood == pytest.approx(total, rel=1e-9)


def test_joints_that_share_nothing_are_taken_apart_and_give_the_same(monkeypatch):
    """Value and gradients with the shortcut and without."""
    generator = torch.Generator().manual_seed(0)
    residual = torch.randn(12, 3, generator=generator, dtype=torch.float64)
    W, found = torch.diag_embed(0.5 + torch.rand(12, 3, generator=generator, dtype=torch.float64)), []
    for apart in (True, False):
        noise = torch.full((1, 3), 0.3, dtype=torch.float64, requires_grad=True)
        roots = torch.randn(3, 12, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        matrices = list((roots @ roots.mT).requires_grad_().unbind())
        assert whole._acts_apart(W)
        monkeypatch.setattr(whole, "_acts_apart", lambda _, apart=apart: apart)
        value = negative_log_likelihood(W, residual, noise, matrices)
        found.append((value.detach(), *torch.autograd.grad(value, [noise, *matrices])))
        monkeypatch.undo()
    for one, other in zip(*found, strict=True):
        assert_close(one + one.mT if one.dim() == 2 else one, other + other.mT if other.dim() == 2 else other)
    assert not whole._acts_apart(W + 1e-9)


def test_it_listens_to_no_contact_and_moves_to_no_other_model():
    data = arm_data(20, 0)
    posterior = fit(data.model.black_box(), data, points=8, restarts=1, options=QUICK)
    assert posterior.model.contacts == ()
    assert posterior.description == "independent GP"
    with pytest.raises(InvalidInput, match="cannot move to another model"):
        posterior.with_contacts(data.model.contacts)
    with pytest.raises(InvalidInput, match="know of no contact"):
        arm_model().with_forces(IndependentAccelerations())
    with pytest.raises(InvalidInput, match="accelerations equal the mean exactly"):
        fit(data.model.black_box(), dataclasses.replace(data, a=np.zeros_like(data.a), truth={}))
