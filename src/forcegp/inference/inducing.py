"""Variational inducing points: all data through a few points per latent, with a bound on what that costs.

The collapsed bound of Titsias (2009, "Variational learning of inducing variables in sparse Gaussian processes"), here
for several latents that share their data through mixing vectors:

    -log p(y) <= -log N(t; 0, Phi Phi^T + I) + 1/2 sum_i sum_c |C_ic|^2 (k_c(z_i, z_i) - |phi_c(z_i)|^2) + the rest

and for data as the model draws them the expected difference, like the expected divergence of the posteriors, is at
most the sum itself, rows times `left_out` (Burt, Rasmussen & van der Wilk 2020, "Convergence of sparse variational
inference in Gaussian process regression", theorem 4): where the points leave nothing of the prior variance
unexplained, bound and posterior are exact. For functions of one or two features (friction curves) some dozens of points
come close, and the cost is linear in the number of rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint
from typing_extensions import override

from forcegp.errors import NumericalError
from forcegp.inference.deflation import Terms, whiten
from forcegp.inference.kernels import LatentKernels
from forcegp.inference.posterior import LatentPosterior
from forcegp.inference.weight_space import WeightSpace, pivoted_cholesky

CHUNK_BYTES = 64 * 2**20
"""Working memory of one block of rows."""

CANDIDATES = 20_000
"""Rows among which inducing points are sought."""

JITTER = 1e-10
"""Added to the kernel matrices of inducing points, relative to their mean diagonal, where hyper-parameters move away
from those that the points were chosen at."""

MOST_ROUNDING = 1e-3
"""Of the prior variance, by which rounding may take what inducing points leave out below 0: `JITTER` and rounding, both
magnified by the condition number of at most 1 / JITTER, stay far below."""


@dataclass(frozen=True, eq=False)
class InducingPosterior(LatentPosterior):
    """The variational posterior; `features` are the inducing points."""

    kernels: LatentKernels
    space: WeightSpace

    @classmethod
    def condition(cls, kernels: LatentKernels, terms: Terms, *, points: int, tolerance: float) -> InducingPosterior:
        """Condition on the data through at most `points` inducing points for each latent.

        Fewer where each latent leaves out less than its share of `tolerance`, see `left_out`.
        """
        with torch.no_grad():
            deflation, features = terms.deflated(), terms.features
            pivots = inducing_pivots(kernels, features, deflation.C, points, tolerance)
            places = [z[found] for z, found in zip(features, pivots, strict=True)]
            return cls(kernels, WeightSpace.of(kernels, features, places, deflation.C, deflation.t))

    @property
    def left_out(self) -> float:
        """What the points leave out of the prior variance of a row, in units of its noise, on average."""
        return self.space.left_out

    @property
    @override
    def features(self) -> tuple[Float[Tensor, "_ _"], ...]:  # type: ignore[override]  # a field there, read only
        return self.space.points

    @property
    @override
    def weights(self) -> tuple[Float[Tensor, " _"], ...]:
        return tuple(w[:, 0] for w in self.space.center_weights(self.space.mean[:, None]))

    @override
    def covariance(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C C"]:
        return self.space.covariance(features)

    @override
    def variance_of(self, index: int, z: Float[Tensor, "n _"]) -> Float[Tensor, " n"]:
        return self.space.variance_of(index, z)

    @override
    def function_weights(
        self, prior: Sequence[Float[Tensor, "S _"]], generator: torch.Generator
    ) -> tuple[Float[Tensor, "S _"], ...]:
        # the values at the points are drawn from their posterior, L_c w_c with w ~ N(mean, B^-1), and what the prior
        # functions have there is taken off
        samples = len(prior[0])
        size = (len(self.space.mean), samples)
        draws = torch.randn(size, generator=generator, dtype=torch.float64, device=self.space.mean.device)
        drawn = self.space.mean[:, None] + self.space.precision.solve_upper(draws)
        whitened = [
            torch.linalg.solve_triangular(lower, values.mT, upper=False)
            for lower, values in zip(self.space.lowers, prior, strict=True)
        ]
        return tuple(w.mT for w in self.space.center_weights(drawn - torch.cat(whitened)))


def inducing_pivots(
    kernels: LatentKernels,
    features: Sequence[Float[Tensor, "N _"]],
    C: Float[Tensor, "N r C"],
    points: int,
    tolerance: float = 0.0,
) -> list[Int[Tensor, " m"]]:
    """Numbers of the rows that are inducing points of each latent: greedy, at most `points` of them.

    Fewer where every latent leaves out less than its share of `tolerance`, see `InducingPosterior.left_out`. They are
    sought among `CANDIDATES` rows at most, spread evenly over all.
    """
    count = len(C)
    candidates = torch.linspace(0, count - 1, min(count, CANDIDATES), dtype=torch.float64).round().long().to(C.device)
    relevance = C.square().sum(1)[candidates]
    share = tolerance / max(1, C.shape[-1]) * len(candidates)
    return [
        candidates[pivoted_cholesky(kernel, z[candidates], relevance[:, c], points, share).indices]
        for c, (kernel, z) in enumerate(zip(kernels.dense, features, strict=True))
    ]


def collapsed_bound(
    W: Float[Tensor, "N D C"],
    residual: Float[Tensor, "N D"],
    noise: Float[Tensor, "#N D"] | Float[Tensor, "#N D D"],
    kernels: LatentKernels,
    parameters: Mapping[str, Tensor],
    features: Sequence[Float[Tensor, "N _"]],
    points: Sequence[Float[Tensor, "_ _"]],
) -> Float[Tensor, ""]:
    """An upper bound of `negative_log_likelihood`, differentiable in every argument but the inducing `points`.

    The kernels are taken at `parameters`. Time O(N P^2) for P points in all, memory O(N C + P^2): blocks of rows are
    computed again in the backward pass. Raises NumericalError when a covariance cannot be factorised, or where rounding
    explains more than all of the prior variance, as at length scales of 1e-10: the sum would be no bound there.
    """
    count, outputs, _ = W.shape
    W_white, y_white, log_noise = whiten(W, residual, noise)
    lowers = [_lower(K) for K in kernels.crosses(parameters, points, points)]
    total = sum(len(lower) for lower in lowers)
    height = max(1, CHUNK_BYTES // (8 * max(1, total) * 4))
    products = W.new_zeros(total, total)
    right, left_out, prior = W.new_zeros(total), W.new_zeros(()), W.new_zeros(())
    for start in range(0, count, height):
        rows = slice(start, start + height)
        block = [z[rows] for z in features]
        statistics = checkpoint(
            _statistics, kernels, parameters, points, lowers, W_white[rows], y_white[rows], block, use_reentrant=False
        )
        so_far = products, right, left_out, prior
        products, right, left_out, prior = (a + b for a, b in zip(so_far, statistics, strict=True))
    if bool(left_out < -MOST_ROUNDING * prior):
        raise NumericalError("rounding hides the covariance of the inducing points; take other parameters")
    B = _lower(products + torch.eye(total, dtype=W.dtype, device=W.device), jitter=0.0)
    explained = torch.linalg.solve_triangular(B, right[:, None], upper=False).square().sum()
    quadratic = y_white.square().sum() - explained
    log_determinant = 2.0 * B.diagonal().log().sum()
    return 0.5 * (quadratic + log_determinant + left_out) + log_noise + 0.5 * count * outputs * math.log(2.0 * math.pi)


def _statistics(
    kernels: LatentKernels,
    parameters: Mapping[str, Tensor],
    points: Sequence[Tensor],
    lowers: Sequence[Tensor],
    W: Float[Tensor, "n D C"],
    y: Float[Tensor, "n D"],
    features: Sequence[Tensor],
) -> tuple[Float[Tensor, "P P"], Float[Tensor, " P"], Float[Tensor, ""], Float[Tensor, ""]]:
    """Phi^T Phi, Phi^T y, what is left out of the prior variance, and that variance, of some rows."""
    crosses = kernels.crosses(parameters, points, features)
    phi = [torch.linalg.solve_triangular(L, K, upper=False) for L, K in zip(lowers, crosses, strict=True)]
    diagonals = kernels.diagonals(parameters, features)
    relevance = W.square().sum(1)
    prior = torch.stack([relevance[:, c] @ k for c, k in enumerate(diagonals)]).sum()
    shares = (relevance[:, c] @ (k - f.square().sum(0)) for c, (k, f) in enumerate(zip(diagonals, phi, strict=True)))
    wide = torch.cat([f[:, None, :] * W[:, :, c].mT for c, f in enumerate(phi)]).flatten(1)
    return wide @ wide.mT, wide @ y.mT.reshape(-1), sum(shares, torch.zeros_like(prior)), prior


def _lower(matrix: Float[Tensor, "n n"], jitter: float = JITTER) -> Float[Tensor, "n n"]:
    shift = jitter * matrix.detach().diagonal().mean() if len(matrix) else 0.0
    lower, info = torch.linalg.cholesky_ex(
        matrix + shift * torch.eye(len(matrix), dtype=matrix.dtype, device=matrix.device)
    )
    if bool(info != 0):
        raise NumericalError(
            "the covariance of the inducing points is not positive definite; give fewer points, or a larger tolerance"
        )
    return lower
