"""One Gaussian process per joint, against dense linear algebra and against the structured model that it is part of."""

import dataclasses
from typing import ClassVar

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from tests.posterior.arm import NOISE, arm_data, arm_model
from tests.posterior.model_conformance import ModelConformance

from forcegp.errors import FitError, InvalidInput
from forcegp.fit import fit
from forcegp.forces import IndependentAccelerations, JointAccelerations, JointForces
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise
from forcegp.posterior import StructuredPosterior
from forcegp.posterior.independent import joint_part, one_joint

QUICK = OptimizerOptions(iterations=15)


class TestIndependentGP(ModelConformance):
    quick: ClassVar = {"restarts": 1, "options": QUICK}

    @classmethod
    def make(cls, model):
        return model.black_box()


class TestStructuredGP(ModelConformance):
    quick: ClassVar = {"restarts": 1, "options": QUICK}

    @classmethod
    def make(cls, model):
        return model.with_forces(JointForces())


@pytest.fixture(scope="module")
def train():
    return arm_data(60, seed=1)


@pytest.fixture(scope="module")
def test():
    return arm_data(100, seed=2)


@pytest.fixture(scope="module")
def posterior(train):
    return fit(train.model.black_box(), train, points=25, restarts=2, options=QUICK)


def dense_covariance(posterior, z, z_other):
    """Block-diagonal covariance (3 n, 3 m) of the functions, joint after joint, written plainly."""
    blocks = []
    for joint in range(3):
        length = posterior.hyperparameters[f"kernels.{joint}.base_kernel.raw_lengthscale"].exp()
        scale = posterior.hyperparameters[f"kernels.{joint}.raw_outputscale"].exp()
        difference = (z[:, None] - z_other[None]) / length
        blocks.append(scale * torch.exp(-0.5 * difference.square().sum(-1)))
    return torch.block_diag(*blocks)


def standardized(posterior, states):
    training = torch.cat([posterior.training.q, posterior.training.v, posterior.training.u], -1)
    return (torch.cat(states, -1) - training.mean(0)) / training.std(0, correction=0)


def test_equals_dense_conditioning_on_the_block_diagonal_covariance(posterior, test):
    t = posterior.training
    z = standardized(posterior, [t.q, t.v, t.u])
    states = [torch.tensor(x[:5]) for x in (test.q, test.v, test.u)]
    z_new = standardized(posterior, states)
    S = dense_covariance(posterior, z, z) + NOISE**2 * torch.eye(75, dtype=torch.float64)
    cross = dense_covariance(posterior, z_new, z)
    y = t.a.mT.reshape(-1)
    mean = (cross @ torch.linalg.solve(S, y)).reshape(3, 5).mT
    covariance = dense_covariance(posterior, z_new, z_new) - cross @ torch.linalg.solve(S, cross.mT)
    prediction = posterior.predict(*states)
    torch.testing.assert_close(prediction.mean, mean, rtol=1e-9, atol=1e-9)
    per_state = covariance.reshape(3, 5, 3, 5).diagonal(dim1=1, dim2=3).permute(2, 0, 1)
    torch.testing.assert_close(prediction.covariance, per_state, rtol=1e-8, atol=1e-9)
    density = multivariate_normal(np.zeros(75), S.numpy()).logpdf(y.numpy())
    assert posterior.negative_log_likelihood == pytest.approx(-density, rel=1e-9)


def test_is_the_structured_model_on_unconstrained_accelerations_without_contacts(posterior, test):
    """B = M and H = M^-1 make W = H B the identity."""
    model = arm_model(contacts=0)
    structured = model.with_forces(JointAccelerations(), noise=Noise(NOISE)).without_mean()
    given = posterior.training, posterior.hyperparameters, posterior.result, {}
    twin = StructuredPosterior.conditioned(structured, *given)
    states = test.q, test.v, test.u
    torch.testing.assert_close(posterior.predict(*states).mean, twin.predict(*states).mean, rtol=1e-8, atol=1e-8)
    mine, theirs = posterior.predict(*states).covariance, twin.predict(*states).covariance
    torch.testing.assert_close(mine, theirs, rtol=1e-8, atol=1e-8)
    assert posterior.negative_log_likelihood == pytest.approx(twin.negative_log_likelihood, abs=1e-8)


def test_starts_where_the_structured_model_starts(train):
    """Without contacts, with every joint's search ending at once: moments, and seeded restarts around them."""
    model = arm_model(contacts=0)
    stay = {"points": 12, "seed": 4, "options": OptimizerOptions(iterations=0)}
    structured = model.with_forces(JointAccelerations()).without_mean()
    for restarts in (1, 3):
        mine = fit(model.black_box(), train, restarts=restarts, **stay)
        theirs = fit(structured, train, restarts=restarts, **stay)
        np.testing.assert_allclose(mine.settings["restart_objective"], theirs.settings["restart_objective"], rtol=1e-9)
    lowest = min(mine.settings["restart_objective"])
    assert mine.result.value <= lowest + 1e-9  # every joint keeps its own best start


def test_the_gradient_of_a_joint_is_that_of_finite_differences(posterior):
    likelihood = posterior.likelihood
    part = {**joint_part(posterior.hyperparameters, 1)}
    kernels = one_joint(likelihood.kernels(), 1)
    free = {name: value.clone().requires_grad_() for name, value in part.items()}
    likelihood(1, kernels, free).backward()
    for name, value in part.items():
        for index in range(min(3, value.numel())):
            step = torch.zeros_like(value)
            step.view(-1)[index] = 1e-5
            ahead = float(likelihood(1, kernels, {**part, name: value + step}))
            behind = float(likelihood(1, kernels, {**part, name: value - step}))
            assert float(free[name].grad.view(-1)[index]) == pytest.approx((ahead - behind) / 2e-5, rel=1e-4, abs=1e-5)


def test_joints_do_not_hear_of_each_other(train, test):
    model = train.model.black_box()
    how = {"points": 20, "restarts": 1, "options": OptimizerOptions(iterations=5)}
    louder = train.a.copy()
    louder[:, 2] *= 3.0
    one = fit(model, train, **how).predict(test.q, test.v, test.u)
    two = fit(model, dataclasses.replace(train, a=louder, truth={}), **how).predict(test.q, test.v, test.u)
    assert torch.equal(one.mean[:, :2], two.mean[:, :2])
    assert not torch.allclose(one.mean[:, 2], two.mean[:, 2])


def smooth_data(rows, seed, noise):
    """The states of the arm with accelerations that are smooth functions of them, and noise per joint."""
    data = arm_data(rows, seed)
    truth = np.stack([np.sin(data.q[:, 0]) + 0.3 * data.u[:, 0], data.v[:, 1] * data.q[:, 2], 0.5 * data.u[:, 2]], 1)
    noisy = truth + np.random.default_rng(seed).normal(0.0, noise, truth.shape)
    return dataclasses.replace(data, a=noisy, truth={"a": truth}, noise_std=np.array(noise))


def test_learns_what_is_smooth_and_knows_how_well():
    train, test = (smooth_data(120, seed, (0.05, 0.05, 0.05)) for seed in (3, 4))
    prediction = fit(train.model.black_box(), train, restarts=1).predict(test.q, test.v, test.u)
    error = np.abs(prediction.mean.numpy() - test.truth["a"])
    assert error.mean() < 0.1 * np.abs(test.truth["a"]).mean()
    inside = np.abs(prediction.mean.numpy() - test.a) < 1.96 * prediction.measurement.std.numpy()
    assert 0.9 < inside.mean() < 0.99


def test_the_noise_is_learned_joint_by_joint():
    data = smooth_data(150, 5, (0.03, 0.1, 0.3))
    model = data.model.black_box(Noise(0.1, learn=True))
    np.testing.assert_allclose(fit(model, data, restarts=1).noise_std, (0.03, 0.1, 0.3), rtol=0.3)


def test_a_warm_start_begins_where_another_fit_ended(train):
    model = train.model.black_box()
    few = fit(model, train, points=40, restarts=1, options=QUICK)
    cold = fit(model, train, points=50, restarts=1, options=OptimizerOptions(iterations=0))
    warm = fit(model, train, points=50, restarts=1, options=OptimizerOptions(iterations=0), start=few.hyperparameters)
    assert warm.settings["warm_start"] is True
    assert warm.result.value < cold.result.value
    for name, value in few.hyperparameters.items():
        assert torch.equal(warm.hyperparameters[name], value)
    with pytest.raises(InvalidInput, match=r"start has 'kernels\.9\.raw_outputscale'"):
        fit(model, train, points=20, start={"kernels.9.raw_outputscale": torch.zeros(())})


@pytest.mark.parametrize("learn", [False, True])
def test_iterates_belong_to_the_history(train, learn):
    model = train.model.black_box(Noise(NOISE, learn=learn))
    options = OptimizerOptions(iterations=6, keep_iterates=True)
    posterior = fit(model, train, points=15, restarts=2, hyperprior=False, options=options)
    result = posterior.result
    assert len(result.iterates) == len(result.history) > 3
    training = posterior.likelihood.training
    for value, iterate in zip(result.history, result.iterates, strict=True):
        assert set(iterate) == set(result.parameters)
        point = {**posterior.hyperparameters, **iterate}
        there = posterior.conditioned(
            posterior.trained, training, point, result, posterior.settings
        ).negative_log_likelihood
        assert there == pytest.approx(value, rel=1e-9)
    assert fit(model, train, points=15, restarts=1, options=OptimizerOptions(iterations=2)).result.iterates == ()


@pytest.mark.nightly  # test_structured_gp.py covers processes
def test_restarts_in_processes_give_the_same(train):
    model = train.model.black_box()
    how = {"points": 12, "restarts": 2, "seed": 7, "options": OptimizerOptions(iterations=3)}
    one, two = fit(model, train, **how), fit(model, train, jobs=2, **how)
    np.testing.assert_allclose(one.settings["restart_objective"], two.settings["restart_objective"], rtol=1e-9)


def test_fewer_inputs_are_all_that_it_listens_to(train, test):
    model = train.model.known.without_mean().with_forces(IndependentAccelerations(inputs=("v",)))
    fitted = fit(model, train, points=20, restarts=1, options=QUICK)
    one = fitted.predict(test.q, test.v, test.u)
    two = fitted.predict(test.q + 0.3, test.v, -test.u)
    assert torch.equal(one.mean, two.mean)


def test_what_makes_no_sense_is_refused(train):
    with pytest.raises(InvalidInput, match="no noise of forces"):
        fit(train.model.black_box(Noise(0.1, 0.2)), train)
    with pytest.raises(InvalidInput, match="give one or more of 'q', 'v', 'u'"):
        IndependentAccelerations(inputs=())
    with pytest.raises(InvalidInput, match="all accelerations are zero"):
        fit(train.model.black_box(), dataclasses.replace(train, a=np.zeros_like(train.a), truth={}))
    huge = dataclasses.replace(train, a=np.full_like(train.a, 1e200), truth={})
    with pytest.raises(FitError, match="none of 2 restarts could be evaluated for joint pan"):
        fit(train.model.black_box(), huge, restarts=2)
