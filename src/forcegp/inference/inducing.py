"""Variational inducing points: all data through a few points per latent, with a bound on what that costs.

Weights w with k_c ~ phi_c . phi_c', phi_c(z) = L_c^-1 k_c(p_c, z), of precision B = I + Phi^T Phi: Titsias
(2009). N times `left_out` bounds, in nats, what it costs (Burt, Rasmussen & van der Wilk 2020, theorem 4).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import accumulate, pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor
from typing_extensions import override

from forcegp.inference.dense_kernels import DenseKernel, LatentKernels
from forcegp.inference.likelihood import CholeskyFactor, Terms, factorize
from forcegp.inference.posterior import BLOCK_BYTES, Features, LatentPosterior

ROUNDING = 1e-13  # remainders below this fraction of the largest k(z, z) are rounding


def pivoted_cholesky(
    kernel: DenseKernel, z: Float[Tensor, "N d"], relevance: Float[Tensor, " N"], most: int, tolerance: float = 0.0
) -> Int[Tensor, " m"]:
    """Numbers of greedy pivots, each where the relevance times what is left of k(z, z) is largest; O(N m^2).

    At most `most`; fewer where relevance times remainder falls below `tolerance`, or nothing but rounding is left.
    Source: Harbrecht, Peters & Schneider (2012), "On the low-rank approximation by the pivoted Cholesky decomposition".
    """
    with torch.no_grad():
        remainder, count = kernel.diagonal(z).clone(), len(z)
        rows = z.new_empty(min(most, count), count)
        indices: list[int] = []
        floor = ROUNDING * float(remainder.max()) if count else 0.0
        while len(indices) < len(rows):
            score = relevance * remainder
            pivot = int(score.argmax())
            if (indices and float(score.sum()) <= tolerance) or float(remainder[pivot]) <= floor:
                break
            done, column = len(indices), kernel.cross(z[pivot : pivot + 1], z)[0]
            column = column - rows[:done].mT @ rows[:done, pivot]
            rows[done] = column / column[pivot].clamp_min(floor).sqrt()
            rows[done, indices] = 0.0  # exactly
            remainder = (remainder - rows[done].square()).clamp_min_(0.0)
            remainder[pivot] = 0.0
            indices.append(pivot)
        return torch.tensor(indices, dtype=torch.long, device=z.device)


CANDIDATES = 20_000  # rows among which inducing points are sought, spread evenly over all


@dataclass(frozen=True, eq=False)
class InducingPosterior(LatentPosterior):
    """The variational posterior of the weights of all latents, which follow each other.

    `features` are the inducing points p_c, `lowers` L_c, `factor` that of the precision B, `mean_weights` (P,) of the
    weights; `left_out`: the mean over rows of the sum over latents of |C_ic|^2 (k_c(z_i, z_i) - |phi_c(z_i)|^2), what
    the points leave out of the prior variance of a row in units of its noise.
    """

    kernels: LatentKernels
    features: tuple[Float[Tensor, "_ _"], ...]
    lowers: tuple[Float[Tensor, "_ _"], ...]
    factor: CholeskyFactor
    mean_weights: Float[Tensor, " P"]
    left_out: float

    @classmethod
    def condition(
        cls, kernels: LatentKernels, terms: Terms, *, points: int, tolerance: float, near: LatentPosterior | None = None
    ) -> "InducingPosterior":
        """On all rows, by at most `points` points per latent; fewer where its share of `tolerance` suffices.

        Points are those of another posterior of the same kernels, where these suffice: to search is half the work.
        Time O(N P^2). Raises NumericalError where the points cannot be factorised.
        """
        with torch.no_grad():
            deflation, features = terms.deflated(), terms.features
            C, count = deflation.C, len(deflation.C)
            relevance, target = C.square().sum(1), (C * deflation.t[..., None]).sum(1)  # of C_i^T t_i
            some = torch.linspace(0, count - 1, min(count, CANDIDATES), dtype=torch.float64).round().long().to(C.device)
            share, centers, lowers = tolerance / max(1, C.shape[-1]) * len(some), [], []
            for c, (kernel, z, own) in enumerate(zip(kernels.dense, features, relevance[some].mT, strict=True)):
                if isinstance(near, cls) and (enough := near._enough(c, z[some], own, points, share)):
                    at, lower = near.features[c][:enough], near.lowers[c][:enough, :enough]
                else:
                    at = z[some[pivoted_cholesky(kernel, z[some], own, points, share)]].detach()
                    lower = factorize(partial(kernel.cross, at, at)).lower.tril()
                centers, lowers = [*centers, at], [*lowers, lower]
            size = sum(map(len, lowers))
            bare = cls(kernels, tuple(centers), tuple(lowers), CholeskyFactor(C.new_empty(0, 0)), C.new_empty(0), 0.0)
            pairs = (C[..., :, None] * C[..., None, :]).sum(1)  # C_i^T C_i
            slices, height = bare.slices, max(1, BLOCK_BYTES // (8 * max(1, size)))

            def sums() -> tuple[Tensor, Tensor, Tensor]:
                """B, Phi^T of the target, and what the points leave out."""
                B, right, left_out = torch.eye(size).to(C), C.new_zeros(size), C.new_zeros(())
                for rows in (slice(start, start + height) for start in range(0, count, height)):
                    block = [z[rows] for z in features]
                    phi = bare.columns(block)
                    for c, left in enumerate(phi):
                        remainder = kernels.dense[c].diagonal(block[c]) - left.square().sum(0)
                        left_out += relevance[rows, c] @ remainder.clamp_min(0.0)
                        right[slices[c]] += left @ target[rows, c]
                        for d, other in enumerate(phi[: c + 1]):
                            B[slices[c], slices[d]] += (left * pairs[rows, c, d]) @ other.mT
                return B, right, left_out

            made = [sums()]
            _, right, left_out = made[0]
            factor = factorize(lambda: (made.pop() if made else sums())[0])  # which is overwritten
            mean = factor.solve(right[:, None])[:, 0] if size else right
            return replace(bare, factor=factor, mean_weights=mean, left_out=float(left_out) / max(1, count))

    def _enough(self, c: int, z: Float[Tensor, "N d"], relevance: Float[Tensor, " N"], most: int, share: float) -> int:
        """How many points of a latent, first ones first, `pivoted_cholesky` would be content with; 0 for not all."""
        [phi] = self.columns([z], [c])
        left = (self.kernels.dense[c].diagonal(z) - phi.square().cumsum(0)).clamp_min(0.0) @ relevance
        reached = (left <= share).nonzero()
        return 1 + int(reached[0]) if len(reached) else most * (len(left) == most)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Which of all weights belong to each latent."""
        ends = accumulate((len(lower) for lower in self.lowers), initial=0)
        return tuple(slice(start, stop) for start, stop in pairwise(ends))

    def columns(self, features: Features, which: Sequence[int] | None = None) -> list[Float[Tensor, "_ n"]]:
        """phi_c at points, one column each; of some latents, or of all."""
        own = zip(range(len(self.lowers)) if which is None else which, features, strict=True)
        crosses = ((c, self.kernels.dense[c].cross(self.features[c], z)) for c, z in own)
        return [torch.linalg.solve_triangular(self.lowers[c], K, upper=False) for c, K in crosses]

    def center_weights(self, weights: Float[Tensor, "P S"]) -> list[Float[Tensor, "_ S"]]:
        """Weights w_c of the features phi_c as those of the kernel functions about the points p_c: L_c^-T w_c."""
        own = zip(self.lowers, self.slices, strict=True)
        return [torch.linalg.solve_triangular(lower.mT, weights[part], upper=True) for lower, part in own]

    @cached_property
    @override
    def weights(self) -> tuple[Float[Tensor, " _"], ...]:  # type: ignore[override]  # a property there, read only
        return tuple(w[:, 0] for w in self.center_weights(self.mean_weights[:, None]))

    @override
    def _covariance_block(self, features: Features, which: Sequence[int]) -> Float[Tensor, "n C C"]:
        # what the weights leave out of k_c, and Phi_z B^-1 Phi_z^T; L^-1 phi_c begins with zeros, which are skipped
        lower, white, out = self.factor.lower, [], features[0].new_empty(len(features[0]), len(which), len(which))
        for k, (c, phi) in enumerate(zip(which, self.columns(features, which), strict=True)):
            first = self.slices[c].start
            right = torch.nn.functional.pad(phi, (0, 0, 0, len(lower) - first - len(phi)))
            white.append(torch.linalg.solve_triangular(lower[first:, first:], right, upper=False))
            for d, other in enumerate(white):
                out[:, k, d] = out[:, d, k] = (white[k] * other[len(other) - len(white[k]) :]).sum(0)
            out[:, k, k] += (self.kernels.dense[c].diagonal(features[k]) - phi.square().sum(0)).clamp_min(0.0)
        return out

    @override
    def function_weights(
        self, prior: Sequence[Float[Tensor, "S _"]], generator: torch.Generator
    ) -> tuple[Float[Tensor, "S _"], ...]:
        # the values at the points are drawn from their posterior, L_c w_c with w ~ N(mean, B^-1), and what the prior
        # functions have there is taken off
        size = len(self.mean_weights), len(prior[0])
        draws = torch.randn(size, generator=generator, dtype=torch.float64, device=self.mean_weights.device)
        drawn, own = self.mean_weights[:, None] + self.factor.solve_upper(draws), zip(self.lowers, prior, strict=True)
        whitened = [torch.linalg.solve_triangular(lower, values.mT, upper=False) for lower, values in own]
        return tuple(w.mT for w in self.center_weights(drawn - torch.cat(whitened)))
