"""A kernel that learns where a force changes fast: a squared exponential on features and on outputs of a small network.

Source: Wilson et al., "Deep kernel learning", AISTATS (2016). Ober et al., "The promises and pitfalls of deep kernel
learning", UAI (2021), show that it overfits without a prior on the network; here every weight has one.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from gpytorch.kernels import Kernel, ScaleKernel
from gpytorch.priors import NormalPrior
from torch import Tensor
from typing_extensions import override

from forcegp.priors.kernel_parameters import float64, log_scale, register_log_normal_prior
from forcegp.priors.stationary_kernels import LOG_LENGTHSCALE_SPREAD, typical_lengthscale

HIDDEN = (8, 8)
"""Units of the hidden layers."""

OUTPUTS = 2
"""Learned features."""

SEED = 20160509
"""Of the start values of the weights, which are the same for every kernel of a dimension."""

FIRST_LAYER_SCALE = 2.0
OUTPUT_SCALE = 1.0


def deep(dimension: int, variance: float | Tensor) -> ScaleKernel:
    """variance times `NetworkKernel`, which starts as the squared exponential of length scales sqrt(dimension)."""
    kernel = ScaleKernel(NetworkKernel(dimension), outputscale_constraint=log_scale()).double()
    kernel.outputscale = float64(variance)
    return kernel


class NetworkKernel(Kernel):
    """k = exp(-1/2 |e(z) - e(z')|^2) with e(z) = [z / l, h(z)] and h a network of two hidden tanh layers.

    Where h is constant this is the squared exponential with length scales l (1, dimension); where h jumps, points on
    the two sides of the jump become independent. The weights are stored in units of their prior: each has N(0, 1), and
    a layer divides by the root of its number of inputs. The last layer starts at zero, so h = 0 at the start.
    """

    has_lengthscale = True

    def __init__(self, dimension: int) -> None:
        super().__init__(ard_num_dims=dimension, lengthscale_constraint=log_scale())
        self.double()
        self.lengthscale = float64(math.sqrt(dimension)).expand(1, dimension)
        register_log_normal_prior(self, "lengthscale", typical_lengthscale(dimension), LOG_LENGTHSCALE_SPREAD)
        generator = torch.Generator().manual_seed(SEED)
        sizes = (dimension, *HIDDEN)
        for layer, (inputs, outputs) in enumerate(pairwise(sizes)):
            # the last column is the bias
            weights = torch.randn(outputs, inputs + 1, generator=generator, dtype=torch.float64)
            self._register_weights(f"hidden_{layer}", weights)
        self._register_weights("output", torch.zeros(OUTPUTS, sizes[-1], dtype=torch.float64))

    def _register_weights(self, name: str, start: Tensor) -> None:
        self.register_parameter(name, torch.nn.Parameter(start))
        prior = NormalPrior(torch.zeros_like(start), torch.ones_like(start))
        self.register_prior(f"{name}_prior", prior, partial(_weights, name))

    def network(self, z: Tensor) -> Tensor:
        """h(z) (n, 2)."""
        scale = FIRST_LAYER_SCALE
        for layer in range(len(HIDDEN)):
            weights = getattr(self, f"hidden_{layer}")
            slope, bias = weights[:, :-1], weights[:, -1]
            z = torch.tanh(scale * (z @ (slope / math.sqrt(slope.shape[1])).mT + bias))
            scale = 1.0
        return OUTPUT_SCALE / math.sqrt(z.shape[-1]) * (z @ torch.as_tensor(self.output).mT)

    def squared_exponential_embedding(self, z: Tensor) -> Tensor:
        """e(z) (n, dimension + 2), in which the kernel is the squared exponential of length scale 1."""
        return torch.cat([z / self.lengthscale, self.network(z)], dim=-1)

    @override
    def forward(
        self, x1: Tensor, x2: Tensor, diag: bool = False, last_dim_is_batch: bool = False, **params: Any
    ) -> Tensor:
        left, right = self.squared_exponential_embedding(x1), self.squared_exponential_embedding(x2)
        difference = left - right if diag else left[..., :, None, :] - right[..., None, :, :]
        return torch.exp(-0.5 * difference.square().sum(-1))


def _weights(name: str, kernel: NetworkKernel) -> Tensor:
    return getattr(kernel, name)
