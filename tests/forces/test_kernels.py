"""Kernels by name: every one of them passes the conformance suite; closed forms; expressions."""

import math

import gpytorch.kernels as gk
import pytest
import torch
from tests.forces.kernel_conformance import KernelConformance
from tests.inference.kernel_functions import kernel_cross, kernel_matrix
from tests.inference.problems import normal
from tests.posterior.arm import arm_model

from forcegp.errors import InvalidInput
from forcegp.forces import JointForces
from forcegp.forces.kernels import KERNELS, checked_kernel, kernel_of
from forcegp.inference import LatentKernels

PLAIN = (
    "squared-exponential", "matern-1/2", "matern-3/2", "matern-5/2", "constant", "linear",
    "linear + squared-exponential + constant",
)  # fmt: skip
for expression in PLAIN:
    name = f"Test {expression}"
    globals()[name] = type(name, (KernelConformance,), {"expression": expression, "__module__": __name__})


class TestFriction(KernelConformance):
    expression = "friction"
    dimensions = (1,)
    variance_at_the_start = False  # tanh^2 is a little below 1


def test_every_name_is_tested():
    assert set(KERNELS) <= {suite.expression for suite in KernelConformance.__subclasses__()}


# ---------------------------------------------------------------- closed forms


def float64(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def matrix(kernel: gk.Kernel, z: torch.Tensor) -> torch.Tensor:
    return kernel_matrix(kernel, z).detach()


def test_friction_against_its_formula():
    kernel = kernel_of("friction", 1, 3.0)
    sign, level = kernel.kernels[0].kernels
    sign.raw_width.data.fill_(math.log(0.2))
    level.kernels[0].constant = float64([0.7])
    level.kernels[1].outputscale = float64(0.4)
    level.kernels[1].base_kernel.raw_width.data.fill_(math.log(0.3))
    level.kernels[1].base_kernel.lengthscale = float64([[0.6]])
    kernel.kernels[1].variance = float64([[0.9]])
    s = normal(7, 1)
    phi, x = torch.tanh(s / 0.2), torch.asinh(s / 0.3)
    expected = phi @ phi.mT * (0.7 + 0.4 * torch.exp(-(x - x.mT).abs() / 0.6)) + 0.9 * s @ s.mT
    torch.testing.assert_close(matrix(kernel, s), expected, rtol=1e-13, atol=1e-14)


def test_friction_is_a_function_of_one_velocity():
    with pytest.raises(InvalidInput, match="one velocity and was given 3 features"):
        kernel_of("friction", 3, 1.0)


def test_linear_against_its_formula():
    kernel, variances = kernel_of("linear", 3, 1.0), float64([[0.5, 2.0, 1.5]])
    kernel.variance = variances
    z = normal(6, 3)
    torch.testing.assert_close(matrix(kernel, z), z @ torch.diag(variances[0]) @ z.mT, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(
    ("name", "formula"),
    [
        ("matern-1/2", lambda r: torch.exp(-r)),
        ("matern-3/2", lambda r: (1 + 3**0.5 * r) * torch.exp(-(3**0.5) * r)),
        ("matern-5/2", lambda r: (1 + 5**0.5 * r + 5 / 3 * r.square()) * torch.exp(-(5**0.5) * r)),
    ],
)
def test_functions_of_the_distance_against_their_formulas(name, formula):
    kernel, z = kernel_of(name, 3, 1.3), normal(6, 3)
    r = (z[:, None] - z[None]).norm(dim=-1) / 3**0.5
    torch.testing.assert_close(matrix(kernel, z), 1.3 * formula(r), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", ["matern-1/2", "matern-3/2"])
def test_points_that_nearly_coincide_keep_their_difference(name):
    """A distance of 1e-9 from a difference of squares would be 1e-8 or nothing."""
    kernel, z = kernel_of(name, 1, 1.0), float64([[5.0], [5.0 + 2.0**-30]])
    missing = 1.0 - float(kernel_cross(kernel, z[:1], z[1:]).detach())
    assert missing == pytest.approx(2.0**-30 if name == "matern-1/2" else 0.0, rel=1e-5, abs=1e-15)


# ---------------------------------------------------------------- expressions


def test_terms_add_up():
    z, names = normal(6, 2), ("squared-exponential", "matern-1/2", "linear")
    one = [matrix(kernel_of(name, 2, 1.0), z) for name in names]
    torch.testing.assert_close(matrix(kernel_of(" +".join(names), 2, 3.0), z), sum(one))


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("linear +", "no kernel '' in 'linear \\+'"),
        ("liner", "no kernel 'liner' in the registry; did you mean 'linear'"),
        ("constant + lienar", "no kernel 'lienar' in 'constant \\+ lienar'; did you mean 'linear'"),
        ("matern", "Valid kernels: constant, friction, linear, matern-1/2"),
    ],
)
def test_wrong_expressions_say_what_is_allowed(expression, message):
    for read in (checked_kernel, lambda text: kernel_of(text, 1, 1.0)):
        with pytest.raises(InvalidInput, match=message):
            read(expression)


def test_a_kernel_of_ones_own(monkeypatch):
    def mine(dimension, variance):
        kernel = gk.ScaleKernel(gk.CosineKernel()).double()
        kernel.outputscale = torch.as_tensor(variance).double()
        return kernel

    monkeypatch.setitem(KERNELS, "mine", mine)
    z = normal(5, 1)
    cosine = torch.cos(math.pi * (z - z.mT) / gk.CosineKernel().double().period_length.detach()[0])
    expected = 0.5 * cosine + 0.5 * z @ z.mT
    torch.testing.assert_close(matrix(kernel_of("mine + linear", 1, 1.0), z), expected, rtol=1e-12, atol=1e-13)


# ---------------------------------------------------------------- priors on parameters


@pytest.mark.parametrize(
    ("expression", "part", "center", "spread"),
    [
        ("matern-5/2", "base_kernel.raw_lengthscale", 0.5 * math.log(2.0) + 3.0, 2.0),
        ("linear", "raw_variance", math.log(0.6 / 2), 2.0),
        ("constant", "raw_constant", math.log(0.6), 2.0),
    ],
)
def test_hyperpriors_are_normal_in_the_logarithm(expression, part, center, spread):
    latent = LatentKernels([kernel_of(expression, 2, 0.6)])
    start, name = latent.initial_parameters(), f"kernels.0.{part}"
    moved, normal_prior = start | {name: start[name] + 0.7}, torch.distributions.Normal(float64(center), spread)
    difference = normal_prior.log_prob(moved[name]).sum() - normal_prior.log_prob(start[name]).sum()
    assert float(latent.log_prior(moved) - latent.log_prior(start)) == pytest.approx(float(difference), rel=1e-9)


def test_the_width_of_friction_has_a_hyperprior():
    latent = LatentKernels([kernel_of("friction", 1, 0.6)])
    start = latent.initial_parameters()
    for name in (
        "kernels.0.kernels.0.kernels.0.raw_width",
        "kernels.0.kernels.0.kernels.1.kernels.1.base_kernel.raw_width",
    ):
        assert float(start[name].exp()) == pytest.approx(0.1)
        moved = latent.log_prior(start | {name: start[name] + 1.5})
        assert float(latent.log_prior(start) - moved) == pytest.approx(1.125)


def test_the_hyperprior_is_normal_in_the_logarithm_of_the_length_scales():
    latent = LatentKernels(JointForces().kernels(arm_model().robot, (4,), torch.ones(1).double()))
    parameters, raw = latent.initial_parameters(), torch.tensor([[0.0, 1.0, 2.0, 5.0]]).double()
    parameters["kernels.0.base_kernel.raw_lengthscale"] = raw.requires_grad_()
    expected = torch.distributions.Normal(torch.tensor(0.5).double() * torch.tensor(4.0).double().log() + 3.0, 2.0)
    value = latent.log_prior(parameters)
    assert float(value.detach()) == pytest.approx(float(expected.log_prob(raw.detach()).sum()), rel=1e-12)
    (gradient,) = torch.autograd.grad(value, raw)
    assert torch.allclose(gradient, (expected.loc - raw) / 4.0)
