"""Noise that differs between rows, and noise of the joint forces: against dense linear algebra, and end to end."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file
from scipy.stats import multivariate_normal
from tests.inference.dense import dense_negative_log_likelihood
from tests.posterior.arm import NOISE, arm_data, arm_model

from forcegp.atomic_files import write_digests
from forcegp.errors import FileFormatError, InvalidInput
from forcegp.evidence import MarginalLikelihood, TrainingData
from forcegp.fit import fit
from forcegp.forces import JointForces
from forcegp.inference import OptimizerOptions
from forcegp.noise import Noise
from forcegp.posterior import load_posterior, save_posterior

QUICK = OptimizerOptions(iterations=25)
CPU = torch.device("cpu")


def profile(rows, seed=0):
    """Standard deviations (rows, 3) from 0.3 to 3 times NOISE."""
    return NOISE * np.exp(np.random.default_rng(seed).uniform(np.log(0.3), np.log(3.0), (rows, 3)))


def uneven(rows, seed, model=None, noise_std=None, force=0.0):
    """Data of the arm with noise of every row, and with H times noise of the forces."""
    data = arm_data(rows, seed, model)
    noise_std = profile(rows, seed) if noise_std is None else noise_std
    generator = np.random.default_rng((seed, 1))
    a = data.truth["a"] + noise_std * generator.normal(size=data.a.shape)
    dynamics = data.model.dynamics(*map(torch.tensor, (data.q, data.v, data.u)))
    a = a + (dynamics.H.numpy() @ (force * generator.normal(size=data.a.shape))[..., None])[..., 0]
    return dataclasses.replace(data, a=a, noise_std=noise_std)


@pytest.fixture(scope="module")
def train():
    return uneven(60, seed=1)


@pytest.fixture(scope="module")
def posterior(train):
    return fit(train.model.with_forces(JointForces()), train, points=30, restarts=1, options=QUICK)


@pytest.mark.parametrize("force", [None, 0.05])
@pytest.mark.parametrize("contacts", [0, 1, 2])
def test_equals_the_dense_formula_with_all_gradients(contacts, force):
    data = uneven(7, seed=0, model=arm_model(contacts))
    model = MarginalLikelihood(data.model.with_forces(JointForces()), TrainingData.of(data, CPU))
    kernels = model.kernels
    named = kernels.initial_parameters() | Noise((0.1, 0.2, 0.3), force).parameters(3)
    parameters = {name: value.requires_grad_() for name, value in named.items()}
    value = model(kernels, parameters)
    gradients = torch.autograd.grad(value, list(parameters.values()))

    features, W, residual, _ = model.terms(parameters)
    stated = torch.tensor(data.noise_std)
    factors = stated / torch.stack([torch.linalg.vector_norm(column) / 7**0.5 for column in stated.T])
    variances = (parameters["noise.log_acceleration"].exp() * factors) ** 2
    covariance = torch.stack([torch.diag(row) for row in variances])
    if force is not None:
        H = model.dynamics.H
        covariance = covariance + H @ torch.diag((2 * parameters["noise.log_force"]).exp()) @ H.mT
    matrices = []
    for joint, z in enumerate(features):
        lengthscale = parameters[f"kernels.{joint}.base_kernel.raw_lengthscale"].exp()
        outputscale = parameters[f"kernels.{joint}.raw_outputscale"].exp()
        matrices.append(outputscale * (-0.5 * ((z[:, None] - z[None]) / lengthscale).square().sum(-1)).exp())
    expected = dense_negative_log_likelihood(W, residual, covariance, matrices)
    wanted = torch.autograd.grad(expected, list(parameters.values()))
    torch.testing.assert_close(value, expected, rtol=1e-9, atol=1e-7)
    for name, one, other in zip(parameters, gradients, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-7, msg=name)
    for name in ("noise.log_acceleration", "noise.log_force") if force is not None else ("noise.log_acceleration",):
        for joint, step in enumerate(1e-5 * torch.eye(3, dtype=torch.float64)):
            at = {key: entry.detach() for key, entry in parameters.items()}
            ahead, behind = (float(model(kernels, at | {name: at[name] + sign * step})) for sign in (1, -1))
            slope = float(gradients[list(parameters).index(name)][joint])
            assert (ahead - behind) / 2e-5 == pytest.approx(slope, rel=1e-5, abs=1e-5)


def test_noise_that_is_not_learned_is_exactly_the_stated_one(posterior, train):
    training = posterior.training
    rows = [int(np.flatnonzero((train.q == q).all(1))[0]) for q in training.q.numpy()]
    torch.testing.assert_close(training.noise_std, torch.tensor(train.noise_std[rows]), rtol=0, atol=0)
    *_, noise = posterior.likelihood.terms(posterior.hyperparameters)
    torch.testing.assert_close(noise, training.noise_std.square(), rtol=1e-12, atol=0)
    with_force = fit(
        train.model.with_forces(JointForces(), noise=Noise(None, 0.07)), train, points=10, restarts=1, options=QUICK
    )
    *_, noise = with_force.likelihood.terms(with_force.hyperparameters)
    H = with_force.likelihood.dynamics.H
    expected = torch.diag_embed(with_force.training.noise_std.square()) + 0.07**2 * H @ H.mT
    torch.testing.assert_close(noise, expected, rtol=1e-9, atol=1e-12)


@settings(max_examples=10)
@given(st.integers(0, 1000), st.floats(0.01, 100.0))
def test_only_the_ratios_of_the_stated_noise_count_where_the_level_is_given(seed, factor):
    data = uneven(6, seed=0, noise_std=profile(6, seed))
    louder = dataclasses.replace(data, noise_std=factor * data.noise_std)
    parameters = Noise(0.1, 0.02).parameters(3)
    noises = []
    for rows in (data, louder):
        model = MarginalLikelihood(rows.model.with_forces(JointForces()), TrainingData.of(rows, CPU))
        *_, noise = model.terms(parameters)
        noises.append(noise)
    torch.testing.assert_close(*noises, rtol=1e-12, atol=1e-15)


def test_rows_that_are_equally_noisy_are_the_constant_noise(train):
    constant = dataclasses.replace(train, noise_std=np.full(3, 0.2))
    table = dataclasses.replace(train, noise_std=np.full((60, 3), 0.2))
    how = {"points": 12, "restarts": 1, "options": OptimizerOptions(iterations=5)}
    for model in (train.model.with_forces(JointForces()), train.model.black_box()):
        one, other = (fit(model, rows, **how).predict(train.q, train.v, train.u) for rows in (constant, table))
        torch.testing.assert_close(one.mean, other.mean, rtol=1e-7, atol=1e-9)
        torch.testing.assert_close(one.measurement.covariance, other.measurement.covariance, rtol=1e-7, atol=1e-9)


def test_knowing_which_rows_are_noisy_helps():
    noise_std = np.where(np.arange(60)[:, None] % 2, 0.05, 3.0) * np.ones(3)
    data, test = uneven(60, seed=4, noise_std=noise_std), arm_data(200, seed=5)
    blind = dataclasses.replace(data, noise_std=data.noise_level)
    errors = []
    for rows in (data, blind):
        fitted = fit(data.model.with_forces(JointForces()), rows, restarts=1, options=QUICK)
        prediction = fitted.predict(test.q, test.v, test.u, covariance=False)
        errors.append(np.abs(prediction.mean.numpy() - test.truth["a"]).mean())
    assert errors[0] < 0.5 * errors[1]


def test_the_level_is_learned_and_the_profile_kept():
    stated = profile(150, seed=3)
    data = dataclasses.replace(uneven(150, seed=3, noise_std=stated), noise_std=3.0 * stated)
    fitted = fit(data.model.with_forces(JointForces(), noise=Noise(None, learn=True)), data, restarts=1, options=QUICK)
    np.testing.assert_allclose(fitted.noise_std, np.sqrt((stated**2).mean(0)), rtol=0.35)
    *_, noise = fitted.likelihood.terms(fitted.hyperparameters)
    ratio = noise.sqrt() / torch.tensor(stated)
    torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio), rtol=1e-9, atol=0)


def test_noise_of_forces_is_learned_beside_that_of_accelerations():
    # without contacts, for those hide what the forces do along their normal
    data = uneven(150, seed=6, model=arm_model(0), noise_std=np.full((150, 3), 0.02), force=0.3)
    noise = Noise(None, 0.1, learn=True)
    fitted = fit(data.model.with_forces(JointForces(), noise=noise), data, restarts=1, options=QUICK)
    learned = fitted.hyperparameters["noise.log_force"].exp()
    assert bool(((learned > 0.15) & (learned < 0.6)).all())
    assert bool((fitted.noise_std < 0.2).all())


@pytest.mark.usefixtures("unchecked")  # rows of a file are checked after they have become TrainingData
def test_a_stored_model_keeps_the_noise_of_its_rows(tmp_path, train):
    noise = Noise(None, 0.05, learn=True)
    fitted = fit(train.model.with_forces(JointForces(), noise=noise), train, points=12, restarts=1, options=QUICK)
    save_posterior(fitted, tmp_path / "run")
    loaded = load_posterior(tmp_path / "run")
    torch.testing.assert_close(loaded.training.noise_std, fitted.training.noise_std, rtol=0, atol=0)
    assert loaded.negative_log_likelihood == fitted.negative_log_likelihood
    states = train.q, train.v, train.u
    torch.testing.assert_close(loaded.predict(*states).mean, fitted.predict(*states).mean, rtol=0, atol=0)
    file = tmp_path / "run" / "tensors.safetensors"
    tensors = load_file(file)
    for damaged in (-tensors["training.noise_std"], tensors["training.noise_std"][:3], torch.zeros(12, 3).float()):
        save_file(tensors | {"training.noise_std": damaged.contiguous()}, file)
        write_digests(file.parent)
        with pytest.raises(FileFormatError, match="noise_std"):
            load_posterior(tmp_path / "run")


def test_independent_processes_weigh_rows_by_their_noise(train):
    fitted = fit(train.model.black_box(), train, points=20, restarts=1, options=QUICK)
    t = fitted.training
    z = torch.cat([t.q, t.v, t.u], -1)
    z = (z - z.mean(0)) / z.std(0, correction=0)
    total = 0.0
    for joint in range(3):
        length = fitted.hyperparameters[f"kernels.{joint}.base_kernel.raw_lengthscale"].exp()
        K = (-0.5 * ((z[:, None] - z[None]) / length).square().sum(-1)).exp()
        K = fitted.hyperparameters[f"kernels.{joint}.raw_outputscale"].exp() * K
        covariance = K + torch.diag(t.noise_std[:, joint] ** 2)
        total -= multivariate_normal(np.zeros(20), covariance.numpy()).logpdf(t.a[:, joint].numpy())
    assert fitted.negative_log_likelihood == pytest.approx(total, rel=1e-9)


def test_a_noise_that_only_data_can_tell_is_none_without_them():
    with pytest.raises(InvalidInput, match="from the dataset of a fit"):
        Noise(None).parameters(3)
    assert Noise.from_dict(Noise(None, 0.1).to_dict()) == Noise(None, 0.1)
