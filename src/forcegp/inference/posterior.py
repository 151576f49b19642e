"""Posterior of the latent functions at new points, and the exact one with rows appended or left out."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.inference import likelihood
from forcegp.inference.dense_kernels import LatentKernels

BLOCK_BYTES = 64 * 2**20  # working memory of one block of test points
Features = Sequence[Float[Tensor, "n _"]]


class LatentPosterior(ABC):
    """p(f_1(z_1), ..., f_C(z_C) | data); `features` are the centres of each latent's kernel functions."""

    kernels: LatentKernels
    features: tuple[Float[Tensor, "_ _"], ...]
    factor: likelihood.CholeskyFactor
    """What covariances are solved with."""
    remedy: ClassVar[str] = "fit with engine='exact' (and fewer points, where memory does not suffice)"
    """What to do where the factorised covariance of all rows is needed."""

    @property
    @abstractmethod
    def weights(self) -> tuple[Float[Tensor, " _"], ...]:
        """The weight w_cj of every centre of each latent."""

    @abstractmethod
    def _covariance_block(self, features: Features, which: Sequence[int]) -> Float[Tensor, "n C C"]:
        """`covariance` of points that fit into memory."""

    @abstractmethod
    def function_weights(
        self, prior: Sequence[Float[Tensor, "S _"]], generator: torch.Generator
    ) -> tuple[Float[Tensor, "S _"], ...]:
        """Weights of S functions drawn from the posterior, given the values of S functions of the prior at the centres.

        f_s,c(z) = prior function + sum_j k_c(z, z_j) w_s,cj (Matheron's rule; Wilson et al. 2020, eq. 10).
        """

    def covariance(self, features: Features, which: Sequence[int] | None = None) -> Float[Tensor, "n C C"]:
        """Cov(f_c, f_d) at the same point, for n points; of some latents, at features of these, or of all."""
        which, points = range(len(self.features)) if which is None else which, len(features[0])
        latents = len(which)
        height = max(1, BLOCK_BYTES // max(1, 8 * latents * len(self.factor.lower)))
        parts = ([z[i : i + height] for z in features] for i in range(0, points, height))
        blocks = [self._covariance_block(part, which) for part in parts]
        return torch.cat(blocks) if blocks else features[0].new_zeros(0, latents, latents)

    def mean(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C"]:
        """E f_c = sum_j k_c(z, z_j) w_cj (Rasmussen & Williams 2006, eq. 2.25); differentiable in the features."""
        return torch.stack([self._mean_of(index, z) for index, z in enumerate(features)], dim=-1)

    def one(self, index: int, z: Float[Tensor, "n _"]) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Mean and variance of one latent at points of its own features."""
        return self._mean_of(index, z), self.covariance([z], [index])[:, 0, 0]

    def _mean_of(self, index: int, z: Float[Tensor, "n d"]) -> Float[Tensor, " n"]:
        kernel, centers, weights = self.kernels.dense[index], self.features[index], self.weights[index]
        if not len(centers):
            return z.new_zeros(len(z))
        height, blocks = max(1, BLOCK_BYTES // (8 * len(centers))), []
        for i in range(0, len(z), height):
            K = kernel.cross(z[i : i + height], centers)
            level = K.detach().mean(1, keepdim=True)  # with long length scales K is nearly constant, and all cancels
            blocks.append((K - level) @ weights + level[:, 0] * self._totals[index])
        return torch.cat(blocks) if blocks else z.new_zeros(0)

    @cached_property
    def _totals(self) -> tuple[float, ...]:  # of the weights, correctly rounded
        return tuple(math.fsum(weights.tolist()) for weights in self.weights)


@dataclass(frozen=True, eq=False)
class ExactPosterior(LatentPosterior):
    """The posterior from the factorised covariance of all training points."""

    kernels: LatentKernels
    features: tuple[Float[Tensor, "N _"], ...]
    system: likelihood.DeflatedSystem

    @classmethod
    def condition(cls, kernels: LatentKernels, terms: likelihood.Terms) -> "ExactPosterior":
        """Condition on the residual y - m."""
        with torch.no_grad():
            system = likelihood.solve_deflated(terms.deflated(), kernels(terms.features))
        return cls(kernels, tuple(z.detach() for z in terms.features), system)

    @property
    @override
    def factor(self) -> likelihood.CholeskyFactor:  # type: ignore[override]  # a field there, read only
        return self.system.factor

    @property
    @override
    def weights(self) -> tuple[Float[Tensor, " N"], ...]:
        return self.system.beta.unbind(-1)

    def data_covariance(self, index: int, z: Float[Tensor, "n _"]) -> Float[Tensor, "R n"]:
        """Cov(data, f(z)) of one latent."""
        return self.system.deflation.through(index, self.kernels.dense[index].cross(z, self.features[index]).mT)

    def joint_covariance(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "Cn Cn"]:
        """Cov(f_c(z_i), f_d(z_j)) at all of n points, by latent. Rasmussen & Williams 2006, eq. 2.26."""
        C = torch.cat([self.data_covariance(index, z) for index, z in enumerate(features)], dim=-1)
        V = self.factor.solve_lower(C)
        prior = torch.block_diag(*[kernel.cross(z, z) for kernel, z in zip(self.kernels.dense, features, strict=True)])
        return prior - V.mT @ V

    @override
    def _covariance_block(self, features: Features, which: Sequence[int]) -> Float[Tensor, "n C C"]:
        # k_c(z, z) delta_cd - V_c^T V_d with V_c = L^-1 Cov(data, f_c(z)) (Rasmussen & Williams 2006, eq. 2.26)
        given = list(zip(which, features, strict=True))
        C = torch.cat([self.data_covariance(c, z) for c, z in given], dim=1)
        V = self.factor.solve_lower(C).unflatten(1, (len(features), -1)).permute(2, 1, 0)
        return torch.diag_embed(torch.stack([self.kernels.dense[c].diagonal(z) for c, z in given], dim=-1)) - V @ V.mT

    @override
    def function_weights(
        self, prior: Sequence[Float[Tensor, "S N"]], generator: torch.Generator
    ) -> tuple[Float[Tensor, "S N"], ...]:
        # (L L^T)^-1 (data - what the prior functions make of them - eps) with eps ~ N(0, 1 + jitter)
        observed, alpha, factor = self.system.deflation, self.system.alpha, self.system.factor
        size = len(prior[0]), alpha.numel()
        noise = torch.randn(size, generator=generator, dtype=alpha.dtype, device=alpha.device).mT
        seen = sum(observed.through(index, values.mT) for index, values in enumerate(prior))
        residual = observed.t.reshape(-1, 1) - seen - math.sqrt(1.0 + factor.jitter) * noise
        weights = factor.solve(residual.contiguous())
        return tuple(observed.back(index, weights).mT for index in range(len(prior)))


def exact(latent: LatentPosterior, what: str) -> ExactPosterior:
    """`latent` itself where it is exact. Raises InvalidInput, saying what is impossible, where it is not."""
    if isinstance(latent, ExactPosterior):
        return latent
    seen = f"{what} needs the factorised covariance of all rows, which a {type(latent).__name__} does not have"
    raise InvalidInput(f"{seen}; {latent.remedy}.")


def with_rows(latent: ExactPosterior, terms: likelihood.Terms) -> ExactPosterior:
    """The posterior of the old rows and those of `terms` (Golub & Van Loan 2013, 4.2.9); the old one stays valid.

    Raises NumericalError where the new ones are not finite or the covariance cannot be factorised.
    """
    with torch.no_grad():
        features, added, old = terms.features, terms.deflated(), latent.system.deflation
        rank = max(old.rank, added.rank)
        factor = _with_rank(latent.system.factor, len(old.t), old.rank, rank)
        old, added = _padded(old, rank), _padded(added, rank)
        cross = added.t.new_zeros(added.t.numel(), old.t.numel())
        for c, (kernel, z, at) in enumerate(zip(latent.kernels.dense, features, latent.features, strict=True)):
            cross += added.through(c, old.through(c, kernel.cross(z, at).mT).mT)
        factor = appended(factor, cross, likelihood.deflated_covariance(added.C, latent.kernels(features)))
        joined = likelihood.Deflation(*map(torch.cat, zip(old, added, strict=True)))
        joint = tuple(torch.cat([z, new.detach()]) for z, new in zip(latent.features, features, strict=True))
        return ExactPosterior(latent.kernels, joint, _solved(joined, factor))


def appended(
    factor: likelihood.CholeskyFactor, cross: Float[Tensor, "m n"], own: Float[Tensor, "m m"]
) -> likelihood.CholeskyFactor:
    """The factor of [[T11, cross^T], [cross, own]] from that of T11, which is copied; `own` is overwritten.

    Only the lower triangle of `own` is read. Jitter is added to the new rows alone, as `factorize` does.
    """
    size, more = factor.lower.shape[0], own.shape[0]
    lower = factor.lower.new_empty(size + more, size + more)
    lower[:size, :size] = factor.lower
    below = factor.solve_lower(cross.mT).mT if size else cross
    lower[size:, :size] = below
    own.sub_(below @ below.mT)
    corner = likelihood.factorize(own.clone)
    lower[size:, size:] = corner.lower
    return likelihood.CholeskyFactor(lower, max(factor.jitter, corner.jitter))


def _solved(deflation: likelihood.Deflation, factor: likelihood.CholeskyFactor) -> likelihood.DeflatedSystem:
    """alpha = T^-1 t and beta from a factor of T."""
    white = factor.solve_lower(deflation.t.reshape(-1, 1))  # two solves of one column, 5 times as fast as LAPACK's
    alpha = factor.solve_upper(white).reshape(deflation.t.shape)
    return likelihood.DeflatedSystem(deflation, factor, alpha, torch.einsum("irc,ir->ic", deflation.C, alpha))


def _padded(deflation: likelihood.Deflation, rank: int) -> likelihood.Deflation:
    """The same with zeros in place of the directions that rows of higher rank have; nothing depends on them."""
    more, pad = rank - deflation.rank, torch.nn.functional.pad
    U, C, t = pad(deflation.U, (0, more)), pad(deflation.C, (0, 0, 0, more)), pad(deflation.t, (0, more))
    return likelihood.Deflation(U, C, t, deflation.remainder)


def _with_rank(factor: likelihood.CholeskyFactor, count: int, rank: int, wanted: int) -> likelihood.CholeskyFactor:
    """The factor of T where every row has `wanted` directions; the new ones have variance 1, of noise alone."""
    if rank == wanted:
        return factor
    lower = torch.eye(count * wanted, dtype=factor.lower.dtype, device=factor.lower.device)
    place = torch.arange(count * wanted, device=lower.device).reshape(count, wanted)[:, :rank].reshape(-1)
    lower[place[:, None], place] = factor.lower.tril()
    return likelihood.CholeskyFactor(lower, factor.jitter)
