"""The joined model against a plain dense Gaussian process, and its gradients in every kind of parameter."""

import numpy as np
import pytest
import torch
from tests.inference.dense import dense_negative_log_likelihood
from tests.posterior.arm import arm_data, arm_model

from forcegp.errors import InvalidInput
from forcegp.evidence import MarginalLikelihood, TrainingData
from forcegp.forces import JointForces
from forcegp.noise import Noise


def likelihood(mean="analytical", rows=8, contacts=1):
    model = arm_model(contacts)
    data = arm_data(rows, seed=0, model=model)
    training = TrainingData(*(torch.tensor(x) for x in (data.q, data.v, data.u, data.a)))
    model = model.with_forces(JointForces())
    return MarginalLikelihood(model if mean == "analytical" else model.without_mean(), training)


def all_parameters(kernels, force=True):
    return kernels.initial_parameters() | Noise(0.1, 0.05 if force else None).parameters(3)


@pytest.mark.parametrize("mean", ["analytical", "zero"])
@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("contacts", [0, 1])
def test_equals_the_dense_formula_with_all_gradients(mean, force, contacts):
    model = likelihood(mean, contacts=contacts)
    kernels = model.kernels
    parameters = {name: value.requires_grad_() for name, value in all_parameters(kernels, force).items()}
    data = model.training

    value = model(kernels, parameters)
    gradients = torch.autograd.grad(value, list(parameters.values()))

    dynamics = arm_model(contacts).dynamics(data.q, data.v, data.u)
    force_known = dynamics.Q_K if mean == "analytical" else torch.zeros_like(data.u)
    m = dynamics.constrained_offset + (dynamics.H @ force_known[..., None])[..., 0]
    z = torch.cat([data.q, data.v, data.u], -1)
    z, matrices = (z - z.mean(0)) / z.std(0, correction=0), []
    for joint in range(3):
        lengthscale = parameters[f"kernels.{joint}.base_kernel.raw_lengthscale"].exp()
        outputscale = parameters[f"kernels.{joint}.raw_outputscale"].exp()
        matrices.append(outputscale * torch.exp(-0.5 * ((z[:, None] - z[None, :]) / lengthscale).square().sum(-1)))
    noise = torch.diag_embed((2 * parameters["noise.log_acceleration"]).exp())
    if force:
        H = dynamics.H
        noise = noise + H @ torch.diag_embed((2 * parameters["noise.log_force"]).exp()) @ H.mT
    expected = dense_negative_log_likelihood(dynamics.H, data.a - m, noise.expand(8, 3, 3), matrices)
    expected_gradients = torch.autograd.grad(expected, list(parameters.values()))

    assert float((value - expected).detach().abs()) < 1e-6
    for name, given, wanted in zip(parameters, gradients, expected_gradients, strict=True):
        assert float((given - wanted).abs().max() / wanted.abs().max().clamp_min(1e-6)) < 1e-7, name


def test_start_values_are_the_moments_of_the_pseudo_inverse_force_residual():
    model = likelihood(rows=20)
    data = model.training
    dynamics = model.model.dynamics(data.q, data.v, data.u)
    residual = data.a - dynamics.acceleration(torch.zeros_like(data.u))
    # minimum norm: H is singular along the contact normal, where no data speak
    force = np.stack(
        [np.linalg.lstsq(H, r, rcond=1e-8)[0] for H, r in zip(dynamics.H.numpy(), residual.numpy(), strict=True)]
    )
    for joint, kernel in enumerate(model.kernels):
        assert kernel.outputscale.item() == pytest.approx(np.square(force[:, joint]).mean(), rel=1e-6)
        assert torch.allclose(kernel.base_kernel.lengthscale, torch.full((1, 9), 3.0).double())


def test_a_constant_feature_keeps_its_scale():
    model = likelihood(rows=6)
    data = model.training
    model = MarginalLikelihood(model.model, TrainingData(data.q, data.v, torch.full_like(data.u, 2.0), data.a))
    assert torch.equal(model.standardization.scale[0][6:], torch.ones(3).double())
    assert bool(torch.isfinite(model(model.kernels, all_parameters(model.kernels))))


def test_data_that_equal_the_mean_have_nothing_to_learn():
    model = likelihood(rows=6)
    data = model.training
    a = model.model.dynamics(data.q, data.v, data.u).acceleration(torch.zeros_like(data.u))
    exact = MarginalLikelihood(model.model, TrainingData(data.q, data.v, data.u, a))
    with pytest.raises(InvalidInput, match="equal the mean exactly"):
        exact.kernels  # noqa: B018  # made when asked for


def test_an_unknown_parameter_is_named():
    model = likelihood()
    with pytest.raises(InvalidInput, match=r"no parameter 'inertial\.hand'"):
        model(model.kernels, all_parameters(model.kernels) | {"inertial.hand": torch.zeros(10).double()})
