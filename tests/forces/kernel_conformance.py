"""What every kernel by name must do. A new kernel is tested by one subclass whose name begins with `Test`:

class TestMine(KernelConformance):
    expression = "mine"
    dimensions = (1, 3)
"""

import copy
import pickle

import gpytorch
import pytest
import torch
from safetensors.torch import load, save
from tests.inference.dense import dense_negative_log_likelihood
from tests.inference.kernel_functions import kernel_cross, kernel_diagonal, kernel_matrix
from tests.inference.problems import normal, problem

from forcegp.fit.search import started
from forcegp.forces.kernels import kernel_of
from forcegp.inference import LatentKernels, negative_log_likelihood

VARIANCE = 1.7


class KernelConformance:
    """Values, gradients, parameters and start values of the kernel `expression`."""

    expression: str
    dimensions: tuple[int, ...] = (1, 3)
    variance_at_the_start = True  # k averages to the asked variance at standardised points

    @pytest.fixture(params=[0, 1], ids=["fewest features", "most features"])
    def dimension(self, request) -> int:
        return self.dimensions[min(request.param, len(self.dimensions) - 1)]

    @pytest.fixture
    def kernel(self, dimension) -> gpytorch.kernels.Kernel:
        """Away from the start, where some parameters may be zero."""
        kernel = kernel_of(self.expression, dimension, VARIANCE)
        for index, value in enumerate(kernel.parameters()):
            value.data += 0.3 * normal(value.numel(), seed=100 + index).reshape(value.shape)
        return kernel

    def test_the_matrix_is_symmetric_and_positive_semidefinite(self, kernel, dimension):
        z = normal(25, dimension)
        z = torch.cat([z, z[:3]])  # twice the same points
        K = kernel_matrix(kernel, z).detach()
        assert K.dtype == torch.float64
        torch.testing.assert_close(K, K.mT, rtol=0.0, atol=1e-14)
        assert torch.linalg.eigvalsh(K)[0] >= -1e-12 * K.diagonal().max()

    def test_the_diagonal_and_blocks_are_those_of_the_matrix(self, kernel, dimension):
        z = normal(9, dimension)
        K = kernel_matrix(kernel, z).detach()
        torch.testing.assert_close(kernel_diagonal(kernel, z).detach(), K.diagonal(), rtol=1e-13, atol=1e-14)
        torch.testing.assert_close(kernel_cross(kernel, z[:4], z[4:]).detach(), K[:4, 4:], rtol=1e-12, atol=1e-13)
        with torch.no_grad():
            torch.testing.assert_close(kernel_matrix(kernel, z), K, rtol=1e-14, atol=1e-14)

    def test_the_matrix_is_the_one_of_gpytorch_point_by_point(self, kernel, dimension):
        """Of one pair at a time: for whole matrices GPyTorch takes roots of sums, which need jitter."""
        z = normal(4, dimension)
        pairs = [[float(kernel(a[None], b[None], diag=True).detach()) for b in z] for a in z]
        expected = torch.tensor(pairs, dtype=torch.float64)
        torch.testing.assert_close(kernel_matrix(kernel, z).detach(), expected, rtol=1e-12, atol=1e-13)

    def test_gradients_of_the_likelihood_in_every_parameter(self, kernel, dimension):
        """Deflated likelihood against finite differences, and against the dense formulation."""
        given = problem(count=5, outputs=3, latents=2, dimension=dimension)
        latent = LatentKernels([kernel, copy.deepcopy(kernel)])
        names, values = zip(*latent.initial_parameters().items(), strict=True)
        leaves = [value.requires_grad_() for value in values]

        def matrices(*parameters):
            return latent.matrices(dict(zip(names, parameters, strict=True)), given.features)

        def likelihood(*parameters):
            return negative_log_likelihood(*given.data, matrices(*parameters))

        assert torch.autograd.gradcheck(likelihood, leaves, rtol=1e-4, atol=1e-6)
        dense = dense_negative_log_likelihood(*given.data, matrices(*leaves))
        torch.testing.assert_close(likelihood(*leaves), dense)
        expected, found = torch.autograd.grad(dense, leaves), torch.autograd.grad(likelihood(*leaves), leaves)
        for gradient, reference in zip(found, expected, strict=True):
            torch.testing.assert_close(gradient, reference, rtol=1e-8, atol=1e-9)

    def test_gradients_in_the_points(self, kernel, dimension):
        """Those of the matrix and of its blocks; they carry parameters inside features, and roll-outs."""
        z, other = normal(4, dimension).requires_grad_(), normal(3, dimension, seed=1).requires_grad_()
        for function, points in ((kernel_matrix, (z,)), (kernel_cross, (z, other))):
            if function(kernel, *points).grad_fn is not None:  # a constant has no gradient
                assert torch.autograd.gradcheck(
                    lambda *x, function=function: function(kernel, *x) + 0.0 * x[0].sum(), points, rtol=1e-5, atol=1e-7
                )

    def test_values_and_gradients_are_finite_at_zero_features(self, dimension):
        latent = LatentKernels([kernel_of(self.expression, dimension, VARIANCE)])
        parameters = {name: value.requires_grad_() for name, value in latent.initial_parameters().items()}
        z = torch.zeros(3, dimension, dtype=torch.float64, requires_grad=True)
        K = latent.matrices(parameters, [z])[0]
        total = K.sum() - latent.log_prior(parameters)
        gradients = torch.autograd.grad(total, [z, *parameters.values()], materialize_grads=True)
        assert all(bool(torch.isfinite(value).all()) for value in (K, *gradients))

    def test_parameters_travel_by_name(self, kernel, dimension):
        """Through a file, a process and a copy; the kernel that receives them is a fresh one."""
        latent, z = LatentKernels([kernel]), [normal(6, dimension)]
        with torch.no_grad():
            expected = latent(z)[0]
            stored = load(save({name: value.contiguous() for name, value in latent.initial_parameters().items()}))
            fresh = LatentKernels([kernel_of(self.expression, dimension, 0.2)])
            begun = fresh.initial_parameters()
            assert {n: v.shape for n, v in begun.items()} == {n: v.shape for n, v in stored.items()}
            moved = {name: value + 0.1 for name, value in stored.items()}
            for received in (pickle.loads(pickle.dumps(latent)), copy.deepcopy(latent)):
                assert torch.equal(received(z)[0], expected)
                assert torch.equal(received.matrices(moved, z)[0], latent.matrices(moved, z)[0])
                assert torch.equal(received.log_prior(moved), latent.log_prior(moved))
            assert torch.equal(fresh.at(stored)(z)[0], expected)
            assert torch.equal(fresh.matrices(stored, z)[0], expected)
            assert not torch.equal(fresh(z)[0], expected)

    def test_it_starts_with_the_variance_that_was_asked_for(self, dimension):
        z = normal(20000, dimension)
        z = (z - z.mean(0)) / z.std(0, correction=0)
        with torch.no_grad():
            mean = float(kernel_diagonal(kernel_of(self.expression, dimension, torch.tensor(2.5).double()), z).mean())
        assert mean == pytest.approx(2.5, rel=1e-10 if self.variance_at_the_start else 0.1)

    def test_every_start_of_a_search_can_be_evaluated(self, dimension):
        """With a value and a slope that lead somewhere."""
        latent = LatentKernels([kernel_of(self.expression, dimension, VARIANCE)])
        z, target = [normal(8, dimension)], normal(8, 1, seed=2)
        for index in range(4):
            start = latent.initial_parameters()
            start = dict(started(start, start, 0, index))
            leaves = {name: value.requires_grad_() for name, value in start.items()}
            noise, W = torch.full((1, 1), 0.01, dtype=torch.float64), torch.ones(8, 1, 1, dtype=torch.float64)
            value = negative_log_likelihood(W, target, noise, latent.matrices(leaves, z)) - latent.log_prior(leaves)
            gradients = torch.autograd.grad(value, list(leaves.values()))
            assert bool(torch.isfinite(value))
            assert all(bool(torch.isfinite(g).all()) for g in gradients)
            assert all(bool(g.abs().max() > 0.0) for g in gradients)
