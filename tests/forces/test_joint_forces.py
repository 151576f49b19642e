"""The prior of the paper: identity mixing, one kernel per joint, standardised inputs; and storage of priors."""

import pytest
import torch
from tests.posterior.arm import arm_model

from forcegp.errors import FileFormatError, InvalidInput
from forcegp.forces import JointForces, Unknown, force_from_dict, force_to_dict
from forcegp.inference import LatentKernels


@pytest.fixture
def dynamics():
    model = arm_model()
    q, v, u = (torch.randn(2, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(k)) for k in range(3))
    return model.dynamics(q, v, u)


def test_mixing_is_the_identity_and_features_are_the_chosen_states(dynamics):
    prior = JointForces(("v", "q"))
    assert torch.equal(prior.direction(dynamics), torch.eye(3).double().expand(2, 4, 3, 3))
    features = prior.features(dynamics)
    assert len(features) == 3
    assert torch.equal(features[1], torch.cat([dynamics.state.v, dynamics.state.q], -1))
    assert prior.latent_names(arm_model().robot) == ("pan", "lift", "bend")


def test_kernels_start_at_the_given_variance_and_the_typical_distance():
    kernels = JointForces().kernels(arm_model().robot, (9, 9, 9), torch.tensor([1.0, 4.0, 0.25]).double())
    z = torch.zeros(1, 9).double()
    assert [kernel(z, z).to_dense().item() for kernel in kernels] == pytest.approx([1.0, 4.0, 0.25])
    assert torch.allclose(kernels[0].base_kernel.lengthscale, torch.tensor(3.0).double())


def test_the_hyperprior_is_normal_in_the_logarithm_of_the_length_scales():
    latent = LatentKernels(JointForces().kernels(arm_model().robot, (4,), torch.ones(1).double()))
    parameters = latent.initial_parameters()
    raw = torch.tensor([[0.0, 1.0, 2.0, 5.0]]).double()
    parameters["kernels.0.base_kernel.raw_lengthscale"] = raw.requires_grad_()
    expected = torch.distributions.Normal(torch.tensor(0.5).double() * torch.tensor(4.0).double().log() + 3.0, 2.0)
    value = latent.log_prior(parameters)
    assert float(value.detach()) == pytest.approx(float(expected.log_prob(raw.detach()).sum()), rel=1e-12)
    (gradient,) = torch.autograd.grad(value, raw)
    assert torch.allclose(gradient, (expected.loc - raw) / 4.0)


def test_wrong_inputs_are_refused():
    for inputs in ((), ("q", "q"), ("torque",)):
        with pytest.raises(InvalidInput, match="'q', 'v', 'u'"):
            JointForces(inputs)


def test_storage_round_trip_and_unknown_priors():
    prior = JointForces(("v",))
    assert force_from_dict(force_to_dict(prior)) == prior
    with pytest.raises(FileFormatError, match="unknown force 'magic'"):
        force_from_dict({"type": "magic"})
    with pytest.raises(FileFormatError, match="wrong fields"):
        force_from_dict({"type": "joint-forces", "colour": 1})

    class Mine(JointForces):
        pass

    with pytest.raises(InvalidInput, match="register it first"):
        force_to_dict(Mine())
    assert isinstance(prior, Unknown)
