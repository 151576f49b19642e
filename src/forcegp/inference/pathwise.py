"""Functions drawn from the posterior (Matheron's rule; Wilson et al. 2020, eq. 10).

Kernels are multiplied out into terms, features times a function of a distance, and drawn term by term: sums of random
cosines (Rahimi & Recht 2007), with frequencies of their own, and an update by the data.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple, cast

import numpy as np
import torch
from gpytorch.kernels import AdditiveKernel, Kernel, ProductKernel, ScaleKernel
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.inference.dense_kernels import PointMap, embedding, weight_features
from forcegp.inference.posterior import LatentPosterior


class SpectralFactor(NamedTuple):
    """A function of the distance in e(z): the squared exponential (smoothness inf) or a Matern.

    Its spectrum is n, or n / sqrt(g) (a Student t distribution), n ~ N(0, I) and g ~ Gamma(smoothness, smoothness).
    """

    embedding: PointMap
    smoothness: float

    def frequencies(self, size: tuple[int, int, int], generator: torch.Generator) -> Float[Tensor, "S e P"]:
        """Independent draws; e entries belong to one frequency."""
        samples, _, count = size
        omega = torch.randn(size, generator=generator, dtype=torch.float64, device=generator.device)
        if self.smoothness == math.inf:
            return omega
        seed = torch.randint(2**62, (), generator=generator, device=generator.device)
        gamma = np.random.default_rng(int(seed)).standard_gamma(self.smoothness, (samples, 1, count)) / self.smoothness
        return omega / torch.as_tensor(np.sqrt(gamma), device=generator.device)


@dataclass(frozen=True, eq=False)
class KernelTerm:
    """One product of a kernel that is multiplied out; `scale` is s."""

    scale: Tensor
    features: tuple[PointMap, ...] = ()
    factors: tuple[SpectralFactor, ...] = ()

    def times(self, other: "KernelTerm") -> "KernelTerm":
        """The term of a product of two kernels."""
        return KernelTerm(self.scale * other.scale, self.features + other.features, self.factors + other.factors)

    def columns(self, z: Float[Tensor, "n d"]) -> Float[Tensor, "n p"]:
        """sqrt(s) phi(z): all products of one entry of every factor's phi."""
        columns = self.scale.to(z.device).sqrt().expand(len(z), 1)
        for feature in self.features:
            columns = (columns[:, :, None] * feature(z)[:, None, :]).flatten(1)
        return columns


def kernel_terms(kernel: Kernel) -> list[KernelTerm]:
    """The kernel, multiplied out. Raises InvalidInput where neither features nor a spectrum are known."""
    one = KernelTerm(torch.ones((), dtype=torch.float64))
    whole = not kernel.batch_shape and kernel.active_dims is None
    if whole:
        if type(kernel) is ScaleKernel:
            scale = KernelTerm(cast(Tensor, kernel.outputscale))
            return [scale.times(term) for term in kernel_terms(kernel.base_kernel)]
        if type(kernel) is AdditiveKernel:
            return [term for part in kernel.kernels for term in kernel_terms(cast(Kernel, part))]
        if type(kernel) is ProductKernel:
            terms = [one]
            for part in kernel.kernels:
                terms = [left.times(right) for left, right in product(terms, kernel_terms(cast(Kernel, part)))]
            return terms
        if (found := embedding(kernel)) is not None:
            return [KernelTerm(one.scale, factors=(SpectralFactor(*found),))]
        if (features := weight_features(kernel)) is not None:
            return [KernelTerm(one.scale, features=(features,))]
    kind = f"{type(kernel).__name__}{'' if whole else ' with active_dims or a batch'}"
    raise InvalidInput(
        f"no functions can be drawn for a {kind}; they can for sums and products of squared exponential, Matern, "
        "linear and constant kernels, and of those that have the method `matern_embedding` or `weight_features`, all "
        "without active_dims; use such kernels, or ask for no samples."
    )


GRID = 4096
"""Points at which a Matern 1/2 is drawn. Between them, h length scales apart, its variance is tanh(h / 2) too small."""


@dataclass(frozen=True, eq=False)
class DrawnTerm:
    """S functions of one term; `weights` are those of its columns, or of cosines and of sines for each column.

    A Matern 1/2 of one input is drawn on an even `grid` 3 length scales beyond the centres, elsewhere expected.
    """

    term: KernelTerm
    frequencies: tuple[Float[Tensor, "S _ P"], ...]
    weights: tuple[Float[Tensor, "S p"]] | tuple[Float[Tensor, "S p P"]] | tuple[Tensor, Tensor]
    grid: Float[Tensor, " P"] | None = None

    @classmethod
    def draw(
        cls, term: KernelTerm, centers: Float[Tensor, "N d"], samples: int, count: int, generator: torch.Generator
    ) -> "DrawnTerm":
        """`count` frequencies for each function."""
        columns = term.columns(centers[:1]).shape[-1]
        embedded = [factor.embedding(centers) for factor in term.factors]
        options = {"generator": generator, "dtype": torch.float64, "device": generator.device}
        if not embedded:
            return cls(term, (), (torch.randn(samples, columns, **options),))
        if [factor.smoothness for factor in term.factors] == [0.5] and embedded[0].shape[-1] == 1:
            from scipy.signal import lfilter  # half a second, which only drawing should cost

            low, high = float(embedded[0].min()) - 3.0, float(embedded[0].max()) + 3.0
            grid = torch.linspace(low, high, GRID, dtype=torch.float64, device=generator.device)
            # an Ornstein-Uhlenbeck process: each value is the last one, less what decays, plus news
            decay, news = math.exp(-(high - low) / (GRID - 1)), math.sqrt(-math.expm1(-2.0 * (high - low) / (GRID - 1)))
            numbers = torch.randn(samples, columns, GRID, **options)
            numbers[..., 0] /= news
            values = lfilter([news], [1.0, -decay], numbers.cpu().numpy())
            return cls(term, (), (torch.as_tensor(values, device=generator.device),), grid)
        each = zip(term.factors, [(samples, e.shape[-1], count) for e in embedded], strict=True)
        frequencies = tuple(factor.frequencies(size, generator) for factor, size in each)
        cosines, sines = torch.randn(2, samples, columns, count, **options) / math.sqrt(count)
        return cls(term, frequencies, (cosines, sines))

    def __call__(self, z: Float[Tensor, "n d"], samples: slice = slice(None)) -> Float[Tensor, "S m"]:
        """The functions `samples` at points of their own, m for each, which follow each other in z."""
        weights = [given[samples] for given in self.weights]
        count = len(weights[0])
        columns = self.term.columns(z).unflatten(0, (count, -1))  # S m p
        if self.grid is not None:
            e, h = self.term.factors[0].embedding(z).unflatten(0, (count, -1)).mT, self.grid[1] - self.grid[0]
            left = ((e - self.grid[0]) / h).clamp(0, len(self.grid) - 2).long()
            at = (e - self.grid[left]).clamp(torch.zeros_like(h), h)
            ends = [weights[0].gather(2, (left + k).expand(-1, weights[0].shape[1], -1)) for k in (0, 1)]
            between = ((h - at).sinh() * ends[0] + at.sinh() * ends[1]) / h.sinh()
            return (columns.mT * (-(e - self.grid[left] - at).abs()).exp() * between).sum(1)
        if not self.frequencies:
            return (columns @ weights[0][..., None])[..., 0]
        drawn = zip(self.term.factors, self.frequencies, strict=True)
        phase = sum(factor.embedding(z).unflatten(0, (count, -1)) @ omega[samples] for factor, omega in drawn)
        assert isinstance(phase, Tensor)
        return (columns * (phase.cos() @ weights[0].mT + phase.sin() @ weights[1].mT)).sum(-1)


FREQUENCIES = 128  # random frequencies of one drawn function, each with a cosine and a sine

BLOCK_BYTES = 16 * 2**20  # working memory of the cosines of functions at the training points


@dataclass(frozen=True, eq=False)
class FunctionSamples:
    """S functions drawn from the posterior of the latents; the same points always give the same values."""

    # whole functions: independent noise in every step would average out along a motion
    latent: LatentPosterior
    terms: tuple[tuple[DrawnTerm, ...], ...]
    beta: tuple[Float[Tensor, "S _"], ...]
    widening: float

    def __call__(self, features: Sequence[Float[Tensor, "S n _"]]) -> Float[Tensor, "S n C"]:
        """Every function at points of its own: f_s,c(z_s,i)."""
        return torch.stack([self._at(index, z) for index, z in enumerate(features)], dim=-1)

    def _at(self, index: int, z: Float[Tensor, "S n d"]) -> Float[Tensor, "S n"]:
        flat = z.flatten(0, 1)
        cross = self.latent.kernels.dense[index].cross(flat, self.latent.features[index]).unflatten(0, z.shape[:2])
        update = (cross @ self.beta[index][..., None])[..., 0]
        return self.widening * _sum(self.terms[index], flat, slice(None)) + update


def draw_functions(
    latent: LatentPosterior, samples: int, seed: int, widening: float = 1.0, frequencies: int = FREQUENCIES
) -> FunctionSamples:
    """Functions drawn from the posterior of the latents, `widening` times as far from its mean; the same for a seed.

    `frequencies` per function and term. InvalidInput for a kernel without features or a spectrum.
    """
    with torch.no_grad():
        device = latent.features[0].device if latent.features else torch.device("cpu")
        generator = torch.Generator(device=device).manual_seed(seed)
        terms = tuple(
            tuple(DrawnTerm.draw(term, z, samples, frequencies, generator) for term in kernel_terms(kernel))
            for kernel, z in zip(latent.kernels, latent.features, strict=True)
        )
        prior = list[Tensor]()
        for drawn, z in zip(terms, latent.features, strict=True):
            few = max(1, BLOCK_BYTES // (8 * max(1, len(z)) * frequencies))  # as all cosines at all points are many
            parts = [slice(start, min(samples, start + few)) for start in range(0, samples, few)]
            prior.append(torch.cat([_sum(drawn, z.repeat(part.stop - part.start, 1), part) for part in parts]))
        drawn = zip(latent.function_weights(prior, generator), latent.weights, strict=True)
        # w f + (1 - w) mean at the centres, of functions f whose prior part is multiplied by w as well
        weights = tuple(widening * own + (1.0 - widening) * mean for own, mean in drawn)
        return FunctionSamples(latent, terms, weights, widening)


def _sum(drawn: Sequence[DrawnTerm], z: Float[Tensor, "n d"], samples: slice) -> Float[Tensor, "S m"]:
    first, *others = [term(z, samples) for term in drawn]
    return sum(others, first)
