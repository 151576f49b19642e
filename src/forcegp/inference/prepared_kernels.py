"""Posterior means of all latents as sums for C, and their covariance compressed, for many calls with few points.

Scaled squared exponentials of latents that share their centres are one product and one exponential (the formula stands
in `kernel_sums`). Every other kernel is summed by itself.

The exact covariance of the latents is k(z, z) - V^T V with V = L^-1 K(z), where K(z) (n, C) is the covariance of the
whitened data with f(z) and L L^T = T theirs. With orthonormal columns B (n, R),

    k(z, z) - (B^T V)^T (B^T V)

is the covariance given only the R numbers (L^-T B)^T t of the data t: that of a Gaussian process which has seen less.
So it is never below the exact one (the difference V^T (I - B B^T) V is positive semidefinite) and needs R instead of n
numbers per latent and centre. B holds leading left singular vectors of V at sample states, each weighted by what it
does to the standard deviations there, found a block at a time, where most is missing, until they are enough: up to a
tenth more than the best ones, in a third of the time that a singular value decomposition takes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.inference.kernel_matrices import squared_exponential_parameters
from forcegp.inference.kernel_sums import KernelSum, PairFunction
from forcegp.inference.posterior import BLOCK_BYTES, ExactPosterior, LatentPosterior

ROUNDING = 1e-7
"""Standard deviations below this fraction of the prior's are rounding: nothing there can be uncertain."""
DIRECTIONS = 128
"""Of so many directions the leading ones are computed at once."""


@dataclass(frozen=True, eq=False)
class Sample:
    """States at which covariances are compared: features of all latents, and W (n, k, C) of what matters, y = W f."""

    features: Sequence[Float[Tensor, "n _"]]
    W: Float[Tensor, "n k C"]


@dataclass(frozen=True, eq=False)
class CompressedCovariance:
    """Cov(f(z)) = k(z, z) - P P^T with P_c = k_c(z, Z) F_c, F_c (N, R); `factors` has those of `kernel_groups`.

    `inflation` holds the standard deviations of y over the exact ones, minus 1, at states that did not choose B.
    """

    factors: tuple[Float[Tensor, "_ _ R"], ...]
    inflation: Float[Tensor, " _"]

    @property
    def rank(self) -> int:
        """R: how many combinations of the data are used."""
        return self.factors[0].shape[-1]

    def at(self, latent: LatentPosterior, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C C"]:
        """The covariance at n points, by torch."""
        parts: dict[int, Tensor] = {}
        for group, F in zip(kernel_groups(latent), self.factors, strict=True):
            for c, own in zip(group, F, strict=True):
                parts[c] = latent.kernels.dense[c].cross(features[c], latent.features[c]) @ own
        P = torch.stack([parts[c] for c in sorted(parts)], dim=1)
        prior = torch.stack([k.diagonal(z) for k, z in zip(latent.kernels.dense, features, strict=True)], dim=-1)
        return torch.diag_embed(prior) - P @ P.mT


def compress(
    latent: ExactPosterior, sample: Sample, check: Sample, *, tolerance: float, largest: int
) -> CompressedCovariance:
    """The smallest rank at which standard deviations at the states of `check` are at most 1 + `tolerance` too large.

    It is `largest` where more would be needed. B is chosen at the states of `sample`.
    """
    with torch.no_grad():
        (D, left), (at, total) = _directions(latent, sample), _directions(latent, check)
        B, excess = D.new_zeros(0, D.shape[1]), total  # in units of the exact variance
        most, allowed = min(largest, *D.shape), (1.0 + tolerance) ** 2 - 1.0
        while len(B) < most and (not len(B) or float(excess.amax()) > allowed):  # one, where data add nothing
            # the leading half of the directions of which most is missing: what is small among them is better chosen
            # among all in the next round
            X = D[left.topk(min(DIRECTIONS, len(left))).indices]
            for _ in range(2):  # once leaves rounding
                X = X - (X @ B.mT) @ B
            U = torch.linalg.svd(X, full_matrices=False)[2][: min(DIRECTIONS // 2, most - len(B))]
            U = torch.linalg.qr((U - (U @ B.mT) @ B).mT)[0].mT
            left -= (U @ D.mT).square_().sum(0)
            excess = excess - (U @ at.mT).square_().sum(0)
            B = torch.cat([B, U])
        # in the order of what they explain at all states, fewer of the same are enough
        B = torch.linalg.svd(torch.linalg.qr(D @ B.mT, mode="r")[1])[2] @ B
        excess = (total - (B @ at.mT).square_().cumsum_(0)).clamp_min_(0.0)
        enough = torch.nonzero(excess.amax(1) <= allowed)
        B = B[: int(enough[0]) + 1] if len(enough) else B
        S = latent.system.factor.solve_upper(B.mT.contiguous())
        C = latent.system.deflation.C
        factors = torch.einsum("jac,jar->cjr", C, S.reshape(*C.shape[:2], -1))
        chosen = tuple(factors[list(group)].contiguous() for group in kernel_groups(latent))
    return CompressedCovariance(chosen, (1.0 + excess[len(B) - 1]).sqrt() - 1.0)


def _directions(latent: ExactPosterior, sample: Sample) -> tuple[Float[Tensor, "_ n"], Float[Tensor, " _"]]:
    """W V^T over the exact standard deviations, one row per state and entry of y, and the rows' squared norms."""
    C = latent.system.deflation.C
    count, rank, latents = C.shape
    points, height = len(sample.W), max(1, BLOCK_BYTES // max(1, 8 * count * rank * latents))
    found = []
    for start in range(0, points, height):
        features, W = [z[start : start + height] for z in sample.features], sample.W[start : start + height]
        cross = torch.stack(
            [k.cross(z, at) for k, z, at in zip(latent.kernels.dense, features, latent.features, strict=True)]
        )
        # W = Y Z with as few rows Z as it has rank: contacts and few latents leave fewer columns to solve for
        Y, scales, Z = torch.linalg.svd(W, full_matrices=False)
        needed = max(1, int((scales > ROUNDING**2 * scales.amax()).sum(1).max()))
        Z = (scales[..., None] * Z)[:, :needed]
        weighted = cross.permute(2, 0, 1)[..., None] * Z.permute(2, 0, 1)  # (N, C, n, needed)
        K = torch.bmm(C, weighted.flatten(2)).flatten(0, 1)
        V = latent.system.factor.solve_lower(K).reshape(len(K), -1, needed)
        y = torch.bmm(Y[..., :needed], V.permute(1, 2, 0))
        prior = torch.stack([k.diagonal(z) for k, z in zip(latent.kernels.dense, features, strict=True)], dim=-1)
        variance, known = torch.einsum("nkc,nc->nk", W.square(), prior), torch.linalg.vector_norm(y, dim=-1)
        left = (variance - known.square()).sqrt()
        counts = left > ROUNDING * variance.sqrt()  # False where NaN
        y /= left[..., None]
        found.append((y.flatten(0, 1) if counts.all() else y[counts], (known / left)[counts]))
    D, known = zip(*found, strict=True)
    return torch.cat(D), torch.cat(known).square()


def kernel_sums(latent: LatentPosterior) -> tuple[KernelSum, ...]:
    """The groups as C functions of the posterior mean. Raises InvalidInput for a kernel that cannot be traced."""
    found = []
    for k, group in enumerate(kernel_groups(latent)):
        centers, kernel = latent.features[group[0]], latent.kernels.dense[group[0]]
        weights = torch.stack([latent.weights[c].detach() for c in group])
        scales = [each for c in group if (each := squared_exponential_parameters(latent.kernels[c])) is not None]
        formulas = _squared_exponentials(centers, scales) if scales else (kernel.cross, kernel.diagonal, (0.0,))
        found.append(KernelSum.of(f"latents{k}", group, centers, weights, *formulas))
    return tuple(found)


def _squared_exponentials(
    centers: Float[Tensor, "N d"], scales: Sequence[tuple[Tensor, Tensor]]
) -> tuple[PairFunction, Callable[[Tensor], Tensor], tuple[float, ...]]:
    """k_c(z, z_j) - s_c of latents with the same centres, k_c(z, z), and s_c, from length scales and variances.

    From the features themselves, less a constant: with long length scales k is nearly s, and sums cancel.
    """
    shift = centers.mean(0)
    precisions = torch.stack([length.detach().expand(centers.shape[-1]) ** -2 for length, _ in scales])
    variances = torch.stack([variance.detach().reshape(()) for _, variance in scales])

    def pair(z: Tensor, center: Tensor) -> Tensor:
        z, center = z - shift, center - shift  # or what cancels would be large
        scaled = z * precisions
        own = -0.5 * (precisions * center.square()).sum(-1)
        return variances * (((scaled * center).sum(-1) + own) - 0.5 * (scaled * z).sum(-1)).expm1()

    return pair, lambda z: variances[None], tuple(variances.tolist())


def kernel_groups(latent: LatentPosterior) -> tuple[tuple[int, ...], ...]:
    """Numbers of the latents that are summed together: first those that are not squared exponentials, each alone."""
    alone: list[tuple[int, ...]] = []
    shared: list[list[int]] = []
    for index, (kernel, centers) in enumerate(zip(latent.kernels, latent.features, strict=True)):
        if squared_exponential_parameters(kernel) is None:
            alone.append((index,))
            continue
        same = next((group for group in shared if torch.equal(latent.features[group[0]], centers)), None)
        if same is None:
            shared.append([index])
        else:
            same.append(index)
    return (*alone, *map(tuple, shared))
