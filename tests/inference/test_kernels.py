import gpytorch.kernels as gk
import pytest
import torch
from gpytorch.constraints import Positive
from gpytorch.priors import GammaPrior, LogNormalPrior
from tests.inference.kernel_functions import kernel_cross, kernel_diagonal, kernel_matrix
from tests.inference.problems import normal

from forcegp.errors import InvalidInput
from forcegp.inference import LatentKernels


def scaled_rbf(dimension: int | None = None) -> gk.ScaleKernel:
    kernel = gk.ScaleKernel(gk.RBFKernel(ard_num_dims=dimension)).double()
    kernel.base_kernel.lengthscale = 0.7 + 0.3 * torch.arange(dimension or 1, dtype=torch.float64)
    kernel.outputscale = 1.7
    return kernel


def log_scaled_rbf() -> gk.ScaleKernel:
    def positive() -> Positive:
        return Positive(transform=torch.exp, inv_transform=torch.log)

    base = gk.RBFKernel(ard_num_dims=3, lengthscale_constraint=positive())
    return gk.ScaleKernel(base, outputscale_constraint=positive()).double()


def periodic() -> gk.Kernel:
    kernel = gk.PeriodicKernel().double()
    kernel.period_length = 4.0
    return kernel


KERNELS = {
    "SE, one length scale": scaled_rbf, "SE, one length scale per input": lambda: scaled_rbf(3),
    "SE, logarithmic": log_scaled_rbf,
    "SE, some inputs": lambda: gk.ScaleKernel(gk.RBFKernel(ard_num_dims=2, active_dims=(0, 2))).double(),
    "SE, some inputs, one length scale": lambda: gk.ScaleKernel(gk.RBFKernel(active_dims=(0, 2))).double(),
    "RBF alone": lambda: gk.RBFKernel(ard_num_dims=3).double(),
    "Matern 5/2": lambda: gk.ScaleKernel(gk.MaternKernel(2.5, ard_num_dims=3)).double(),
    "Matern 1/2": lambda: gk.ScaleKernel(gk.MaternKernel(0.5)).double(),
    "Matern 3/2, some inputs": lambda: gk.ScaleKernel(
        gk.MaternKernel(1.5, ard_num_dims=2, active_dims=(0, 2))
    ).double(),
    "Matern alone": lambda: gk.MaternKernel(1.5, ard_num_dims=3).double(),
    "rational quadratic": lambda: gk.ScaleKernel(gk.RQKernel()).double(),
    "periodic": lambda: gk.ScaleKernel(periodic()).double(), "linear": lambda: gk.LinearKernel().double(),
    "periodic, one period per input": lambda: gk.PeriodicKernel(ard_num_dims=3).double(),
    "constant and Matern": lambda: (gk.ConstantKernel() + gk.MaternKernel(2.5)).double(),
    "sum": lambda: (gk.ScaleKernel(gk.RBFKernel()) + gk.LinearKernel()).double(),
    "product": lambda: (gk.RBFKernel() * gk.LinearKernel(ard_num_dims=3)).double(),
    "scaled sum of some inputs": lambda: gk.ScaleKernel(
        gk.RBFKernel(active_dims=(1,)) + gk.MaternKernel(2.5, active_dims=(0, 2))
    ).double(),
    "sum with a kernel that is called": lambda: (gk.ScaleKernel(gk.RQKernel()) + gk.RBFKernel()).double(),
}  # fmt: skip


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
def test_matrix_cross_and_diagonal_agree_with_gpytorch_and_each_other(kernel):
    kernel, z, other = kernel(), normal(7, 3), normal(4, 3, seed=1)
    matrix = kernel_matrix(kernel, z)
    torch.testing.assert_close(matrix, kernel(z, z).to_dense(), rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(matrix, matrix.mT, rtol=0.0, atol=1e-14)
    torch.testing.assert_close(kernel_cross(kernel, other, z), kernel(other, z).to_dense(), rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(kernel_cross(kernel, z, z), matrix, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(kernel_diagonal(kernel, z), matrix.diagonal(), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
def test_gradients_are_those_of_gpytorch(kernel):
    """With a weight that is not symmetric, as any upstream gradient may be."""
    kernel, z, weight = kernel(), normal(7, 3).requires_grad_(), normal(7, 7, seed=1)
    leaves = [z, *kernel.parameters()]
    gradients = torch.autograd.grad((weight * kernel_matrix(kernel, z)).sum(), leaves)
    expected = torch.autograd.grad((weight * kernel(z, z).to_dense()).sum(), leaves)
    for gradient, reference in zip(gradients, expected, strict=True):
        torch.testing.assert_close(gradient, reference, rtol=1e-10, atol=1e-12)


def test_the_variance_of_a_point_is_the_output_scale_to_the_last_bit():
    """Rounding of |z_i - z_i|^2 would make it smaller."""
    kernel = scaled_rbf(3)
    assert torch.equal(kernel_matrix(kernel, 1e3 * normal(30, 3)).diagonal(), kernel.outputscale.expand(30))


@pytest.mark.parametrize("shift", [1e3, 1e6])
def test_features_far_from_zero_lose_nothing(shift):
    """Differences alone count, so neither values nor gradients may cancel; the rounding of the shift itself remains."""
    kernel, weight = scaled_rbf(3), normal(6, 6, seed=1)
    near = (normal(6, 3) * 2**10).round() / 2**10  # so that near + shift is exact
    leaves = [near.clone().requires_grad_(), *kernel.parameters()]
    expected = torch.autograd.grad((weight * kernel(leaves[0], leaves[0]).to_dense()).sum(), leaves)
    far = (near + shift).requires_grad_()
    gradients = torch.autograd.grad((weight * kernel_matrix(kernel, far)).sum(), [far, *kernel.parameters()])
    for gradient, reference in zip(gradients, expected, strict=True):
        torch.testing.assert_close(gradient, reference, rtol=0.0, atol=1e-15 * shift + 1e-13)
    with torch.no_grad():
        torch.testing.assert_close(
            kernel_cross(kernel, near[:2] + shift, far), kernel_cross(kernel, near[:2], near), rtol=0.0,
            atol=1e-15 * shift,
        )  # fmt: skip


# ---------------------------------------------------------------- several latents


def three_kernels() -> LatentKernels:
    return LatentKernels([scaled_rbf(3), gk.MaternKernel(2.5).double(), gk.LinearKernel().double()])


def test_matrices_at_other_parameters_and_their_gradients():
    """`functional_call` and the recomputation of checkpointed kernels meet here: both must see the given parameters."""
    kernels, features = three_kernels(), [normal(5, 3, seed=c) for c in range(3)]
    kept = kernels.initial_parameters()
    moved = {name: (value + 0.3).requires_grad_() for name, value in kept.items()}
    matrices, weights = kernels.matrices(moved, features), [normal(5, 5, seed=10 + c) for c in range(3)]
    total = sum((weight * K).sum() for weight, K in zip(weights, matrices, strict=True))
    gradients = torch.autograd.grad(total, list(moved.values()))
    for name, value in kernels.named_parameters():
        assert torch.equal(value, kept[name])
        value.data += 0.3
    plain = [kernel(z, z).to_dense() for kernel, z in zip(kernels.kernels, features, strict=True)]
    expected = torch.autograd.grad(
        sum((weight * K).sum() for weight, K in zip(weights, plain, strict=True)), list(kernels.parameters())
    )
    for K, reference in zip(matrices, plain, strict=True):
        torch.testing.assert_close(K, reference)
    for gradient, reference in zip(gradients, expected, strict=True):
        torch.testing.assert_close(gradient, reference)


def with_priors() -> gk.ScaleKernel:
    base = gk.RBFKernel(ard_num_dims=3, lengthscale_prior=LogNormalPrior(0.3, 0.8))
    return gk.ScaleKernel(base, outputscale_prior=GammaPrior(2.0, 0.5)).double()


def test_log_prior_and_its_gradient():
    kernels = LatentKernels([with_priors(), gk.LinearKernel().double(), with_priors()])
    parameters = {name: (value + 0.2).requires_grad_() for name, value in kernels.initial_parameters().items()}
    value, expected = kernels.log_prior(parameters), 0.0
    for c in (0, 2):
        lengthscale = torch.nn.functional.softplus(parameters[f"kernels.{c}.base_kernel.raw_lengthscale"])
        outputscale = torch.nn.functional.softplus(parameters[f"kernels.{c}.raw_outputscale"])
        expected = expected + torch.distributions.LogNormal(0.3, 0.8).log_prob(lengthscale).sum()
        expected = expected + torch.distributions.Gamma(2.0, 0.5).log_prob(outputscale)
    torch.testing.assert_close(value, expected, rtol=1e-6, atol=0.0)
    leaves = [tensor for name, tensor in parameters.items() if "kernels.1" not in name]
    gradients = (torch.autograd.grad(each, leaves) for each in (value, expected))
    for gradient, reference in zip(*gradients, strict=True):
        torch.testing.assert_close(gradient, reference, rtol=1e-6, atol=1e-8)


def test_a_kernel_that_latents_share_has_one_prior():
    kernel = with_priors()
    alone, shared = LatentKernels([kernel]), LatentKernels([kernel] * 3)
    assert torch.equal(alone.log_prior(alone.initial_parameters()), shared.log_prior(shared.initial_parameters()))


def test_a_copy_at_other_parameters_leaves_the_original_alone():
    kernels = three_kernels()
    before = kernels.initial_parameters()
    moved = {name: value + 1.0 for name, value in before.items()}
    copy = kernels.at(moved)
    for name, value in copy.named_parameters():
        assert torch.equal(value, moved[name])
        assert not value.requires_grad
        value.data += 1.0
    for name, value in kernels.named_parameters():
        assert torch.equal(value, before[name])
        assert value.requires_grad
    for name, value in before.items():
        assert torch.equal(moved[name], value + 1.0)


def test_float32_kernels_are_refused():
    with pytest.raises(InvalidInput, match=r"kernels.1.raw_outputscale is torch.float32; .* call .double\(\)"):
        LatentKernels([scaled_rbf(), gk.ScaleKernel(gk.RBFKernel())])
