"""The posterior covariance from few linear combinations of the data, for control rates.

The exact covariance of the latents is k(z, z) - V^T V with V = L^-1 K(z), where K(z) (n, C) is the covariance of the
whitened data with f(z) and L L^T = T theirs. With orthonormal columns B (n, R),

    k(z, z) - (B^T V)^T (B^T V)

is the covariance given only the R numbers (L^-T B)^T t of the data t: that of a Gaussian process which has seen less.
So it is never below the exact one (the difference V^T (I - B B^T) V is positive semidefinite) and needs R instead of n
numbers per latent and centre. B holds the leading left singular vectors of V at sample states, each weighted by what
it does to the standard deviations there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.inference.posterior import BLOCK_BYTES, ExactPosterior

ROUNDING = 1e-7
"""Standard deviations below this fraction of the prior's are rounding: nothing there can be uncertain."""
FEWEST, SMALL, ITERATIONS = 256, 1000, 2
"""Singular vectors that are tried first, rows of a matrix of which all are computed at once, and power iterations."""


@dataclass(frozen=True, eq=False)
class Sample:
    """States at which covariances are compared: features of all latents, and W (n, k, C) of what matters, y = W f."""

    features: Sequence[Float[Tensor, "n _"]]
    W: Float[Tensor, "n k C"]


@dataclass(frozen=True, eq=False)
class CompressedCovariance:
    """Cov(f(z)) = k(z, z) - P P^T with P_c = k_c(z, Z) F_c, F_c (N, R); `factors` has those of groups of latents.

    `inflation` holds the standard deviations of y over the exact ones, minus 1, at states that did not choose B.
    """

    factors: tuple[Float[Tensor, "_ _ R"], ...]
    inflation: Float[Tensor, " _"]

    @property
    def rank(self) -> int:
        """R: how many combinations of the data are used."""
        return self.factors[0].shape[-1]

    def roots(self, cross: Sequence[Float[Tensor, "n _ _"]]) -> list[Float[Tensor, "n _ _"]]:
        """P from the kernel functions of every group."""
        return [torch.bmm(k.transpose(0, 1), F).transpose(0, 1) for k, F in zip(cross, self.factors, strict=True)]


def compress(
    latent: ExactPosterior,
    groups: Sequence[Sequence[int]],
    sample: Sample,
    check: Sample,
    *,
    tolerance: float,
    largest: int,
) -> CompressedCovariance:
    """The smallest rank at which standard deviations at the states of `check` are at most 1 + `tolerance` too large.

    It is `largest` where more would be needed. B is chosen at the states of `sample`.
    """
    with torch.no_grad():
        D, _ = _directions(latent, sample)
        at, total = _directions(latent, check)
        most, count = min(largest, *D.shape), FEWEST
        while True:
            B = _leading(D, min(count, most))
            excess = (total - (B.mT @ at).square_().cumsum_(0)).clamp_min_(0.0)  # in units of the exact variance
            enough = torch.nonzero((1.0 + excess.amax(1)).sqrt() - 1.0 <= tolerance)
            if len(enough) or count >= most:
                break
            count *= 2
        rank = int(enough[0]) + 1 if len(enough) else most
        S = latent.system.factor.solve_upper(B[:, :rank].contiguous())
        C = latent.system.deflation.C
        factors = torch.einsum("jac,jar->cjr", C, S.reshape(*C.shape[:2], rank))
        chosen = tuple(factors[list(group)].contiguous() for group in groups)
    return CompressedCovariance(chosen, (1.0 + excess[rank - 1]).sqrt() - 1.0)


def _leading(D: Float[Tensor, "n m"], count: int) -> Float[Tensor, "n count"]:
    """Leading left singular vectors of D; where D is large, nearly, by subspace iteration.

    Halko, Martinsson & Tropp, "Finding structure with randomness" (2011), algorithms 4.4 and 5.3.
    """
    if len(D) > max(SMALL, 2 * count):
        X = torch.randn(D.shape[1], count, dtype=D.dtype, generator=torch.Generator().manual_seed(0)).to(D.device)
        for _ in range(ITERATIONS):
            X = D.mT @ torch.linalg.qr(D @ X)[0]
        X = torch.linalg.qr(D @ X)[0]
        return X @ _leading(X.mT @ D, count)
    # not of D D^T: squared, what matters where nearly all is known would hide the rest
    return torch.linalg.svd(torch.linalg.qr(D.mT, mode="r")[1].mT)[0][:, :count]


def _directions(latent: ExactPosterior, sample: Sample) -> tuple[Float[Tensor, "n _"], Float[Tensor, " _"]]:
    """V W^T over the exact standard deviations, one column per state and entry of y, and the squared columns' sums."""
    C = latent.system.deflation.C
    count, rank, latents = C.shape
    points, height = len(sample.W), max(1, BLOCK_BYTES // max(1, 8 * count * rank * latents))
    found = []
    for start in range(0, points, height):
        features, W = [z[start : start + height] for z in sample.features], sample.W[start : start + height]
        cross = torch.stack(
            [k.cross(z, at) for k, z, at in zip(latent.kernels.dense, features, latent.features, strict=True)]
        )
        V = torch.einsum("cnj,jac->jacn", cross, C).reshape(count * rank, -1)
        V = latent.system.factor.solve_lower(V).reshape(count * rank, latents, -1)
        y = torch.einsum("acn,nkc->ank", V, W)
        prior = torch.stack([k.diagonal(z) for k, z in zip(latent.kernels.dense, features, strict=True)], dim=-1)
        variance = torch.einsum("nkc,nc->nk", W.square(), prior)
        left = (variance - y.square().sum(0)).sqrt()
        counts = left > ROUNDING * variance.sqrt()  # False where NaN
        found.append((y / torch.where(counts, left, 1.0))[:, counts])
    D = torch.cat(found, dim=1)
    return D, D.square().sum(0)
