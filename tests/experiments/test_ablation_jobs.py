"""The ablation: the dense formulation against the deflated one, filtered training data, and test rows seen before."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.experiments.stored_jobs import DATA, keep
from tests.models.arm import NOISE, arm_data

from forcegp.data import farthest_rows, zero_phase_low_pass
from forcegp.experiments import ablation_jobs
from forcegp.experiments.fits import MODEL
from forcegp.inference import OptimizerOptions
from forcegp.models import MarginalLikelihood, Noise, StructuredGP, TrainingData, save_posterior

OPTIONS = {"iterations": 3, "tolerance": 1e-6}


@pytest.fixture(scope="module")
def formulations():
    """Both as functions of the parameters, and parameters away from the start."""
    data = arm_data(15, seed=0)
    model = StructuredGP(data.system, mean="zero")
    training = TrainingData(*(torch.tensor(x) for x in (data.q, data.v, data.u, data.a)))
    likelihood = MarginalLikelihood(data.system, model.prior, model.mean, training)
    noise = Noise((NOISE, 2 * NOISE, 3 * NOISE)).parameters(3)
    generator = torch.Generator().manual_seed(0)
    begin = {
        name: value + 0.3 * torch.randn(value.shape, generator=generator, dtype=torch.float64)
        for name, value in likelihood.kernels().initial_parameters().items()
    }
    return ablation_jobs._Deflated(likelihood, noise), ablation_jobs._Dense(likelihood, noise), begin


def test_dense_and_deflated_likelihood_have_the_same_value_and_gradients(formulations):
    found = []
    for objective in formulations[:2]:
        parameters = {name: value.clone().requires_grad_() for name, value in formulations[2].items()}
        value = objective(parameters)
        found.append((value.detach(), torch.autograd.grad(value, list(parameters.values()))))
    (ours, our_gradients), (theirs, their_gradients) = found
    torch.testing.assert_close(ours, theirs, rtol=1e-8, atol=1e-8)
    assert any(gradient.abs().max() > 1e-2 for gradient in their_gradients)
    for one, other in zip(our_gradients, their_gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-8)


def test_the_dense_likelihood_is_the_density_of_a_normal_distribution(formulations):
    """Of the accelerations, with the covariance written out entry by entry."""
    _, dense, parameters = formulations
    features, W, residual, noise = dense.likelihood.terms({**dense.noise, **parameters})
    count, joints, latents = W.shape
    covariance = torch.zeros(count, joints, count, joints, dtype=torch.float64)
    for c in range(latents):
        lengthscale = parameters[f"kernels.{c}.base_kernel.raw_lengthscale"].exp().reshape(-1)
        variance = parameters[f"kernels.{c}.raw_outputscale"].exp()
        for i in range(count):
            for j in range(count):
                difference = (features[c][i] - features[c][j]) / lengthscale
                k = variance * torch.exp(-0.5 * difference @ difference)
                covariance[i, :, j] += k * torch.outer(W[i, :, c], W[j, :, c])
    flat = covariance.reshape(count * joints, -1) + torch.diag(noise.expand(count, joints).reshape(-1))
    normal = torch.distributions.MultivariateNormal(torch.zeros(count * joints, dtype=torch.float64), flat)
    torch.testing.assert_close(dense(parameters), -normal.log_prob(residual.reshape(-1)), rtol=1e-9, atol=1e-9)


def test_the_reported_difference_is_small_only_for_equal_objectives(formulations):
    ours, theirs, begin = formulations
    assert ablation_jobs._gradient_difference(ours, theirs, begin) < 1e-8
    louder = replace(theirs, noise={name: value + 1e-3 for name, value in theirs.noise.items()})
    assert ablation_jobs._gradient_difference(ours, louder, begin) > 1e-5


@pytest.mark.parametrize("cutoff", [None, 25.0])
def test_a_filter_acts_on_the_training_accelerations_alone(run, motion, tmp_path, cutoff):
    spec = {"data": DATA, "seed": 1, "train_seconds": 2, "model": "s-gp-mean", "points": 15, "cutoff": cutoff}
    found = ablation_jobs.filtered(run, {**spec, **OPTIONS}, tmp_path)["evaluation"]
    data = motion
    if cutoff is not None:
        data = replace(motion, a=zero_phase_low_pass(motion.a, 240.0, cutoff), noise_std=None)
    model = StructuredGP(motion.system, noise=Noise(0.1, learn=True))
    posterior = model.fit(farthest_rows(data, 15), restarts=1, seed=1, options=OptimizerOptions(**OPTIONS))
    test = motion.rows(slice(None, None, 4))
    mean = posterior.predict(test.q, test.v, test.u, covariance=False).mean.numpy()
    assert found["mae"] == pytest.approx(float(np.abs(mean - test.a).mean()), rel=1e-6)


def test_the_window_counts_the_rows_that_were_trained_on(run, motion, tmp_path):
    chosen = [*range(0, 60, 3), *range(1, 61, 3)]  # twenty of the window, which takes every third row, and twenty not
    train = motion.rows(chosen)
    posterior = StructuredGP(motion.system).fit(train, restarts=1, options=OptimizerOptions(iterations=0))
    keep(run, "fits/overlap", {}, {}, lambda folder: save_posterior(posterior, folder / MODEL))
    spec = {"seed": 1, "train_seconds": 2, "fit": "fits/overlap"}
    found = ablation_jobs.overlap(run, spec, tmp_path)
    assert found["shared"] == pytest.approx(20 / 160)
    window = motion.rows(slice(0, None, 3))
    mean = posterior.predict(window.q, window.v, window.u, covariance=False).mean.numpy()
    assert found["mae"] == pytest.approx(float(np.abs(mean - window.a).mean()), rel=1e-6)
    assert found["mae_noise_free"] == pytest.approx(float(np.abs(mean - window.truth["a"]).mean()), rel=1e-6)
