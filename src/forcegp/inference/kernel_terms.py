"""Kernels multiplied out into terms whose functions can be drawn.

A term is s (phi . phi') k_1 k_2 ... with finitely many features phi and functions k_i of the distance in embeddings
e_i. Its functions are sqrt(s) sum_p phi_p(z) g_p(z), each g_p a sum of random cosines with phase sum_i omega_i . e_i(z)
(Rahimi & Recht 2007), for the spectrum of a product is the convolution of the spectra. That of the squared exponential
is normal; those of a Matern and of the rational quadratic are normal with a random, Gamma distributed scale (Rasmussen
& Williams 2006, sections 4.2.1 and 5.4.3). Terms without any k_i are drawn exactly.
"""

import math
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import cast

import numpy as np
import torch
from gpytorch.kernels import AdditiveKernel, Kernel, ProductKernel, RQKernel, ScaleKernel
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.inference.kernel_matrices import PointMap, embedding, scaled, weight_features


@dataclass(frozen=True, eq=False)
class SpectralFactor:
    """A function of the distance in e(z), by its spectrum: omega = g^power n with n ~ N(0, I), g ~ Gamma(shape, shape).

    The squared exponential has power 0, a Matern of smoothness nu shape nu and power -1/2 (a Student t distribution),
    the rational quadratic shape alpha and power 1/2.
    """

    embedding: PointMap
    power: float = 0.0
    shape: float = math.inf

    def frequencies(self, size: tuple[int, int, int], generator: torch.Generator) -> Float[Tensor, "S e P"]:
        """Independent draws; e entries belong to one frequency."""
        samples, _, count = size
        omega = torch.randn(size, generator=generator, dtype=torch.float64, device=generator.device)
        if not self.power:
            return omega
        seed = torch.randint(2**62, (), generator=generator, device=generator.device)
        gamma = np.random.default_rng(int(seed)).standard_gamma(self.shape, (samples, 1, count)) / self.shape
        return omega * torch.as_tensor(gamma**self.power, device=generator.device)


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
        factor = _spectral_factor(kernel)
        if factor is not None:
            return [KernelTerm(one.scale, factors=(factor,))]
        features = weight_features(kernel)
        if features is not None:
            return [KernelTerm(one.scale, features=(features,))]
    kind = f"{type(kernel).__name__}{'' if whole else ' with active_dims or a batch'}"
    raise InvalidInput(
        f"no functions can be drawn for a {kind}; they can for sums and products of squared exponential, Matern, "
        "rational quadratic, periodic, linear and constant kernels, and of those that have the method "
        "`squared_exponential_embedding`, `matern_embedding` or `weight_features`, all without active_dims; use such "
        "kernels, or ask for no samples."
    )


def _spectral_factor(kernel: Kernel) -> SpectralFactor | None:
    if type(kernel) is RQKernel:
        return SpectralFactor(partial(scaled, kernel), 0.5, float(kernel.alpha.detach()))
    found = embedding(kernel)
    if found is None:
        return None
    embed, smoothness = found
    return SpectralFactor(embed) if smoothness == math.inf else SpectralFactor(embed, -0.5, smoothness)


GRID = 4096
"""Points at which a Matern 1/2 is drawn. Between them, h length scales apart, its variance is tanh(h / 2) too small."""


@dataclass(frozen=True, eq=False)
class DrawnTerm:
    """S functions of one term; `weights` are those of its columns, or those of cosines and of sines for each column.

    A Matern 1/2 has frequencies without bound. Of one input it is drawn at the points of an even `grid` instead, which
    reaches 3 length scales beyond the centres; `weights` are its values there, and elsewhere it is their expectation.
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
        if [(factor.shape, factor.power) for factor in term.factors] == [(0.5, -0.5)] and embedded[0].shape[-1] == 1:
            from scipy.signal import lfilter  # half a second, which only drawing should cost

            low, high = float(embedded[0].min()) - 3.0, float(embedded[0].max()) + 3.0
            grid = torch.linspace(low, high, GRID, dtype=torch.float64, device=generator.device)
            # an Ornstein-Uhlenbeck process: each value is the last one, less what decays, plus news
            decay, news = math.exp(-(high - low) / (GRID - 1)), math.sqrt(-math.expm1(-2.0 * (high - low) / (GRID - 1)))
            numbers = torch.randn(samples, columns, GRID, **options)
            numbers[..., 0] /= news
            values = lfilter([news], [1.0, -decay], numbers.cpu().numpy())
            return cls(term, (), (torch.as_tensor(values, device=generator.device),), grid)
        frequencies = tuple(
            factor.frequencies((samples, e.shape[-1], count), generator)
            for factor, e in zip(term.factors, embedded, strict=True)
        )
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
            beyond = (-(e - self.grid[left] - at).abs()).exp()
            return (columns.mT * beyond * between).sum(1)
        if not self.frequencies:
            return (columns @ weights[0][..., None])[..., 0]
        phase = sum(
            factor.embedding(z).unflatten(0, (count, -1)) @ frequencies[samples]
            for factor, frequencies in zip(self.term.factors, self.frequencies, strict=True)
        )
        assert isinstance(phase, Tensor)
        waves = phase.cos() @ weights[0].mT + phase.sin() @ weights[1].mT
        return (columns * waves).sum(-1)
