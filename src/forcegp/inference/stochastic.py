"""Hyper-parameters from mini-batches: stochastic variational inference in force space, on GPyTorch's strategy.

All latents are one Gaussian process on pairs (number of the latent, its features), whose kernel is zero between
different latents; GPyTorch's whitened variational strategy then holds one normal distribution of all inducing values,
with the correlations between latents that the mixing vectors make. The expected log likelihood of a row,

    E log N(y~_i; W~_i f(z_i), I) = -1/2 |y~_i - W~_i mu_i|^2 - 1/2 tr(W~_i Sigma_i W~_i^T) - D/2 log 2 pi,

is known, so that nothing is sampled but the rows (Hensman, Fusi & Lawrence 2013, "Gaussian processes for big data").
Inducing values follow natural gradients, hyper-parameters Adam (Salimbeni, Eleftheriadis & Hensman 2018, "Natural
gradients in practice"). The search begins at, and is followed by, an `InducingPosterior`.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence

import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.models import ApproximateGP
from gpytorch.optim import NGD
from gpytorch.variational import NaturalVariationalDistribution, VariationalStrategy
from jaxtyping import Float
from linear_operator import to_linear_operator
from torch import Tensor
from typing_extensions import override

from forcegp.errors import NumericalError
from forcegp.inference.dense_kernels import LatentKernels
from forcegp.inference.inducing import InducingPosterior
from forcegp.inference.likelihood import Terms, whiten
from forcegp.inference.optimization import OptimizationResult

JITTER = 1e-8
"""Added to the kernel matrix of the inducing points and to that of a batch, in the latents' units squared."""

AVERAGED = 20
"""Steps whose bounds are averaged for the history, for a single one is noisy."""


def stochastic_search(
    kernels: LatentKernels,
    begin: InducingPosterior,
    terms: Callable[[Mapping[str, Tensor]], Terms],
    start: Mapping[str, Tensor],
    penalty: Callable[[Mapping[str, Tensor]], Tensor],
    *,
    steps: int,
    batch: int,
    rate: float,
    natural_rate: float = 0.1,
    seed: int = 0,
    report: Callable[[int, float], None] | None = None,
) -> OptimizationResult:
    """Lower the negative bound plus `penalty(parameters)` from `start` by so many steps on `batch` rows each.

    `begin` is the posterior at `start`, whose inducing points stay where they are; `terms(parameters)` gives the data,
    whose noise alone may depend on the parameters. Raises NumericalError where the bound is not finite.
    """
    clock = time.process_time()
    generator = torch.Generator().manual_seed(seed)
    free = {name: value.detach().clone().requires_grad_() for name, value in start.items()}
    model = _AllLatents(kernels, begin)
    moved = torch.optim.Adam(list(free.values()), lr=rate)
    rows = len(terms(free).W)
    natural = NGD(model.variational_parameters(), num_data=1, lr=natural_rate)
    history: list[float] = []
    recent: list[float] = []
    for step in range(steps):
        chosen = torch.randint(rows, (min(batch, rows),), generator=generator)
        moved.zero_grad()
        natural.zero_grad()
        W, y, log_noise, features = _batch(terms(free), chosen.to(begin.space.mean.device))
        expected = model.expected(free, W, y, features) - log_noise
        loss = model.divergence() - rows / len(chosen) * expected + penalty(free)
        if not bool(torch.isfinite(loss)):
            raise NumericalError(
                f"the stochastic bound is not finite after {step} steps; give a smaller rate ({rate} now) "
                "or a larger batch"
            )
        loss.backward()
        natural.step()
        moved.step()
        recent.append(float(loss.detach()))
        if len(recent) == AVERAGED or step + 1 == steps:
            history.append(sum(recent) / len(recent))
            recent.clear()
        if report is not None:
            report(step + 1, history[-1] if history else recent[-1])
    parameters = {name: value.detach() for name, value in free.items()}
    status = f"{steps} steps on {batch} rows each"
    return OptimizationResult(
        parameters, history[-1], tuple(history), status, False, steps, time.process_time() - clock
    )


def _batch(terms: Terms, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
    noise = terms.noise if len(terms.noise) == 1 else terms.noise[rows]
    W, y, log_noise = whiten(terms.W[rows], terms.residual[rows], noise)
    return W, y, log_noise, [z[rows] for z in terms.features]


class _AllLatents(ApproximateGP):
    """All latents as one process; its inputs are (number of the latent, features filled up with zeros)."""

    def __init__(self, kernels: LatentKernels, begin: InducingPosterior) -> None:
        points = _numbered(begin.features)
        distribution = NaturalVariationalDistribution(len(points), mean_init_std=0.0)
        super().__init__(
            VariationalStrategy(self, points, distribution, learn_inducing_locations=False, jitter_val=JITTER)
        )
        self.latents = kernels
        self.widths = [z.shape[-1] for z in begin.features]
        self.at: Mapping[str, Tensor] = kernels.initial_parameters()
        lower = begin.space.precision.lower.tril()
        precision = lower @ lower.mT
        self.double().to(points.device)
        self.variational_strategy.variational_params_initialized.fill_(1)
        distribution.natural_vec.data = precision @ begin.space.mean
        distribution.natural_mat.data = -0.5 * precision

    @override
    def forward(self, x: Float[Tensor, "n _"]) -> MultivariateNormal:
        covariance = x.new_zeros(len(x), len(x))
        rows = [torch.nonzero(x[:, 0] == c)[:, 0] for c in range(len(self.widths))]
        given = [x[own, 1 : 1 + width] for own, width in zip(rows, self.widths, strict=True)]
        for own, block in zip(rows, self.latents.crosses(self.at, given, given), strict=True):
            covariance = covariance.index_put((own[:, None], own[None, :]), block)
        return MultivariateNormal(x.new_zeros(len(x)), to_linear_operator(covariance))

    def expected(
        self,
        parameters: Mapping[str, Tensor],
        W: Float[Tensor, "n D C"],
        y: Float[Tensor, "n D"],
        features: Sequence[Float[Tensor, "n _"]],
    ) -> Float[Tensor, ""]:
        """The expected log likelihood of whitened rows, summed."""
        self.at = parameters
        count, outputs, latents = W.shape
        inside = self(_numbered(features), diag=False)
        mean = inside.mean.reshape(latents, count).mT
        wide = inside.covariance_matrix.reshape(latents, count, latents, count)
        covariance = wide.diagonal(dim1=1, dim2=3).movedim(-1, 0)
        misfit = (y - (W @ mean[..., None])[..., 0]).square().sum()
        spread = (W @ covariance * W).sum()
        return -0.5 * (misfit + spread + count * outputs * math.log(2.0 * math.pi))

    def divergence(self) -> Float[Tensor, ""]:
        """The Kullback-Leibler divergence of the inducing values from their prior."""
        return self.variational_strategy.kl_divergence().sum()


def _numbered(features: Sequence[Float[Tensor, "_ _"]]) -> Float[Tensor, "n d"]:
    width = max(z.shape[-1] for z in features)
    parts = [
        torch.cat([z.new_full((len(z), 1), float(c)), torch.nn.functional.pad(z, (0, width - z.shape[-1]))], dim=-1)
        for c, z in enumerate(features)
    ]
    return torch.cat(parts)
