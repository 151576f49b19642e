"""Pathwise conditioning: functions drawn from the posterior, and its mean, evaluated fast at few points many times.

A drawn function is a prior sample plus an update by the data (Matheron's rule; Wilson et al. 2020, "Efficiently
sampling functions from Gaussian process posteriors", eq. 10), with the centres z_j of the posterior:

    f_s(z) = g_s(z) + sum_j k(z, z_j) beta_s,j

with g_s a sum of random cosines (Rahimi & Recht 2007). Every drawn function has frequencies of its own, so that over
many functions mean and covariance are exactly those of the posterior; only the shape of the distribution is
approximate, and the better the more cosines there are. Squared exponentials of all latents are one batched operation
(`FunctionSamples`); sums and products of other kernels are drawn term by term (`ComposedSamples`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput
from forcegp.inference.kernel_matrices import squared_exponential_parameters
from forcegp.inference.kernel_terms import DrawnTerm, kernel_terms
from forcegp.inference.posterior import LatentPosterior

FREQUENCIES = 256
"""Random frequencies of one drawn function, each with a cosine and a sine."""


BLOCK_BYTES = 16 * 2**20
"""Working memory of the cosines of functions at the training points."""


@dataclass(frozen=True, eq=False)
class StackedKernels:
    """The squared exponentials of all latents as one batched operation, with the centres of the posterior.

    Features are divided by their length scales; latents with fewer features are padded with zeros, which changes no
    distance, and latents with fewer centres with some at zero, whose weights must be 0 (`stacked`).
    """

    lengthscales: tuple[Float[Tensor, " _"], ...]
    variances: Float[Tensor, " C"]
    centers: Float[Tensor, "C 1 d"]
    training: Float[Tensor, "C N d"]

    @classmethod
    def of(cls, latent: LatentPosterior) -> "StackedKernels | None":
        """None if some kernel is not a scaled squared exponential, or if there are no latents."""
        parameters = [squared_exponential_parameters(kernel) for kernel in latent.kernels]
        if not parameters or any(found is None for found in parameters):
            return None
        lengthscales, variances = zip(*(found for found in parameters if found is not None), strict=True)
        lengthscales = tuple(
            scale.detach().expand(z.shape[-1]) for scale, z in zip(lengthscales, latent.features, strict=True)
        )
        training = _scaled(latent.features, lengthscales)
        centers = training.mean(1, keepdim=True)
        return cls(lengthscales, torch.stack([s.detach() for s in variances]), centers, training - centers)

    def scaled(self, features: Sequence[Float[Tensor, "*n _"]]) -> Float[Tensor, "C n d"]:
        """Features over length scales about the centre of the training points, flattened to one batch dimension."""
        return _scaled([z.reshape(-1, z.shape[-1]) for z in features], self.lengthscales) - self.centers

    def cross(self, scaled: Float[Tensor, "C n d"]) -> Float[Tensor, "C n N"]:
        """k_c(z, z_j) for points from `scaled`."""
        squares = scaled.square().sum(-1)[..., :, None] + self.training.square().sum(-1)[..., None, :]
        distance = torch.baddbmm(squares, scaled, self.training.mT, alpha=-2.0).clamp_min_(0.0)
        return distance.mul_(-0.5).exp_() * self.variances[:, None, None]  # not in place: exp needs its result


def mean_function(latent: LatentPosterior) -> Callable[[Sequence[Tensor]], Tensor]:
    """`latent.mean`, prepared for many calls with few points; kernels that cannot be stacked are evaluated by it."""
    with torch.no_grad():
        kernels, weights = StackedKernels.of(latent), stacked(latent.weights)
    if kernels is None:
        return latent.mean
    return lambda features: (kernels.cross(kernels.scaled(features)) @ weights[..., None])[..., 0].mT


@dataclass(frozen=True, eq=False)
class FunctionSamples:
    """S functions drawn from the posterior of the latents; the same points always give the same values.

    `frequencies` are those of the scaled features; `amplitudes` hold the weights of cosines and sines, `beta` those of
    the training points.
    """

    kernels: StackedKernels
    frequencies: Float[Tensor, "S C d P"]
    amplitudes: Float[Tensor, "2 S C P"]
    beta: Float[Tensor, "S C N"]

    @classmethod
    def draw(
        cls, latent: LatentPosterior, samples: int, seed: int, frequencies: int = FREQUENCIES, widening: float = 1.0
    ) -> "FunctionSamples":
        """Draw functions, `widening` times as far from the mean; the same seed gives the same ones.

        Raises InvalidInput if a kernel is not a scaled squared exponential; `draw_functions` takes others, too.
        """
        with torch.no_grad():
            kernels = StackedKernels.of(latent)
            if kernels is None:
                raise InvalidInput("only scaled squared exponentials can be stacked; call draw_functions instead")
            generator = torch.Generator(device=kernels.training.device).manual_seed(seed)
            like = {"generator": generator, "dtype": torch.float64, "device": kernels.training.device}
            latents, _, dimension = kernels.training.shape
            omega = torch.randn(samples, latents, dimension, frequencies, **like)
            scale = (kernels.variances / frequencies).sqrt()[:, None]
            amplitudes = scale * torch.randn(2, samples, latents, frequencies, **like)
            prior = torch.stack(  # one function at a time, for all its cosines at all points are many numbers
                [_cosines(kernels.training, omega[s], amplitudes[:, s]) for s in range(samples)], dim=1
            )
            at_centers = [values[:, : len(z)] for values, z in zip(prior, latent.features, strict=True)]
            weights = _widened(latent, latent.function_weights(at_centers, generator), widening)
        return cls(kernels, omega, widening * amplitudes, stacked(weights).transpose(0, 1))

    def __call__(self, features: Sequence[Float[Tensor, "S n _"]]) -> Float[Tensor, "S n C"]:
        """Every function at points of its own: f_s,c(z_s,i)."""
        samples = self.beta.shape[0]
        scaled = self.kernels.scaled(features)
        cross = self.kernels.cross(scaled).unflatten(1, (samples, -1))  # C S n N
        update = (cross @ self.beta.transpose(0, 1)[..., None])[..., 0]
        points = scaled.unflatten(1, (samples, -1)).transpose(0, 1)
        prior = _cosines(points, self.frequencies, self.amplitudes)
        return prior.movedim(1, -1) + update.permute(1, 2, 0)

    def one(self, index: int, z: Float[Tensor, "n d"]) -> Float[Tensor, "S n"]:
        """All functions of one latent at the same points."""
        kernels, own, d = self.kernels, slice(index, index + 1), z.shape[-1]
        kernels = StackedKernels(
            kernels.lengthscales[own], kernels.variances[own], kernels.centers[own, :, :d], kernels.training[own, :, :d]
        )
        alone = FunctionSamples(kernels, self.frequencies[:, own, :d], self.amplitudes[:, :, own], self.beta[:, own])
        return alone([z.expand(len(self.beta), -1, -1)])[..., 0]


@dataclass(frozen=True, eq=False)
class ComposedSamples:
    """S functions drawn from the posterior of the latents, whose kernels are sums and products."""

    # whole functions: independent noise in every step would average out along a motion
    latent: LatentPosterior
    terms: tuple[tuple[DrawnTerm, ...], ...]
    beta: tuple[Float[Tensor, "S _"], ...]
    widening: float

    @classmethod
    def draw(
        cls, latent: LatentPosterior, samples: int, seed: int, frequencies: int = FREQUENCIES, widening: float = 1.0
    ) -> "ComposedSamples":
        """As `FunctionSamples.draw`, `frequencies` per function and term. Raises InvalidInput as `kernel_terms`."""
        with torch.no_grad():
            generator = torch.Generator(device=latent.features[0].device).manual_seed(seed)
            terms = tuple(
                tuple(DrawnTerm.draw(term, z, samples, frequencies, generator) for term in kernel_terms(kernel))
                for kernel, z in zip(latent.kernels, latent.features, strict=True)
            )
            prior = [
                _at_same_points(drawn, z, samples, frequencies) for drawn, z in zip(terms, latent.features, strict=True)
            ]
            weights = _widened(latent, latent.function_weights(prior, generator), widening)
            return cls(latent, terms, tuple(weights), widening)

    def __call__(self, features: Sequence[Float[Tensor, "S n _"]]) -> Float[Tensor, "S n C"]:
        """Every function at points of its own: f_s,c(z_s,i)."""
        return torch.stack([self._at(index, z) for index, z in enumerate(features)], dim=-1)

    def one(self, index: int, z: Float[Tensor, "n d"]) -> Float[Tensor, "S n"]:
        """All functions of one latent at the same points."""
        return self._at(index, z.expand(len(self.beta[index]), -1, -1))

    def _at(self, index: int, z: Float[Tensor, "S n d"]) -> Float[Tensor, "S n"]:
        flat = z.flatten(0, 1)
        cross = self.latent.kernels.dense[index].cross(flat, self.latent.features[index]).unflatten(0, z.shape[:2])
        update = (cross @ self.beta[index][..., None])[..., 0]
        return self.widening * _sum(self.terms[index], flat, slice(None)) + update


def draw_functions(
    latent: LatentPosterior, samples: int, seed: int, widening: float = 1.0
) -> FunctionSamples | ComposedSamples:
    """Functions drawn from the posterior of the latents, `widening` times as far from its mean.

    The same seed gives the same ones.
    Raises InvalidInput for a kernel of which neither features nor a spectrum are known.
    """
    with torch.no_grad():
        stacked = StackedKernels.of(latent) is not None
    return (FunctionSamples if stacked else ComposedSamples).draw(latent, samples, seed, widening=widening)


def _widened(latent: LatentPosterior, weights: Sequence[Tensor], widening: float) -> list[Tensor]:
    """w f + (1 - w) mean at the centres, of functions f whose prior part is multiplied by w as well."""
    return [widening * drawn + (1.0 - widening) * mean for drawn, mean in zip(weights, latent.weights, strict=True)]


def _sum(drawn: Sequence[DrawnTerm], z: Float[Tensor, "n d"], samples: slice) -> Float[Tensor, "S m"]:
    first, *others = [term(z, samples) for term in drawn]
    return sum(others, first)


def _at_same_points(
    drawn: Sequence[DrawnTerm], z: Float[Tensor, "N d"], samples: int, frequencies: int
) -> Float[Tensor, "S N"]:
    """All functions at z, a few at a time, for all their cosines at all points are many numbers."""
    few = max(1, BLOCK_BYTES // (8 * max(1, len(z)) * frequencies))
    parts = [slice(start, min(samples, start + few)) for start in range(0, samples, few)]
    return torch.cat([_sum(drawn, z.repeat(part.stop - part.start, 1), part) for part in parts])


def _cosines(
    points: Float[Tensor, "*batch n d"],
    frequencies: Float[Tensor, "*batch d P"],
    amplitudes: Float[Tensor, "2 *batch P"],
) -> Float[Tensor, "*batch n"]:
    """sum_p amplitude_0p cos(omega_p z) + amplitude_1p sin(omega_p z)."""
    phase = points @ frequencies
    return (phase.cos() @ amplitudes[0][..., None] + phase.sin() @ amplitudes[1][..., None])[..., 0]


def _scaled(features: Sequence[Tensor], lengthscales: Sequence[Tensor]) -> Float[Tensor, "C n d"]:
    widest = max(z.shape[-1] for z in features)
    most = max(len(z) for z in features)
    return torch.stack(
        [
            torch.nn.functional.pad(z / scale, (0, widest - z.shape[-1], 0, most - len(z)))
            for z, scale in zip(features, lengthscales, strict=True)
        ]
    )


def stacked(weights: Sequence[Float[Tensor, "*S _"]]) -> Float[Tensor, "C *S N"]:
    """Weights of all latents as one tensor, with zeros for the centres that a latent has not."""
    if not weights:
        return torch.zeros(0, 0, dtype=torch.float64)
    most = max(w.shape[-1] for w in weights)
    return torch.stack([torch.nn.functional.pad(w, (0, most - w.shape[-1])) for w in weights])
