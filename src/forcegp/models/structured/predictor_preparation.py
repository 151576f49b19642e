"""A structured posterior made ready for control rates: tape of its terms, kernels, compressed covariance."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalWarning
from forcegp.inference.compressed_covariance import CompressedCovariance, Sample, compress
from forcegp.inference.posterior import ExactPosterior, LatentPosterior
from forcegp.inference.prepared_kernels import PreparedKernels
from forcegp.models.predictor import Predictor
from forcegp.models.predictor_terms import EagerTerms, TapedTerms, TermsFunction
from forcegp.models.training_data import TrainingData

COVARIANCES = ("auto", "compressed", "exact", "none")
SAMPLES, CHECKS = 300, 150
"""States that choose the compressed covariance, and others that show how good it is."""
STEP = 0.3
"""Length of a step away from a training state, in differences of two others."""

TermsOf = Callable[[PreparedKernels, bool], TermsFunction]
"""(kernels, whether to give the prepared features, too) -> the terms as a function of the state."""


def prepared_predictor(
    latent: LatentPosterior,
    widening: float,
    training: TrainingData,
    terms_of: TermsOf,
    *,
    covariance: str,
    tolerance: float,
    largest_rank: int,
    compile: bool,
) -> Predictor:
    """What `StructuredPosterior.predictor` documents, from the posterior of the latents and the terms of a state."""
    if covariance not in COVARIANCES:
        raise InvalidInput(f"covariance is {covariance!r}; give one of {', '.join(map(repr, COVARIANCES))}.")
    if not (0.0 < tolerance < math.inf and isinstance(largest_rank, int) and largest_rank >= 1):
        raise InvalidInput(
            f"tolerance is {tolerance!r} and largest_rank is {largest_rank!r}; give a positive number, for example "
            "0.01, and an integer from 1."
        )
    begin = time.perf_counter()
    nv, device = training.q.shape[-1], training.q.device
    if covariance == "auto":
        covariance = "compressed" if isinstance(latent, ExactPosterior) else "exact"
    prepared = PreparedKernels.of(latent, compile)
    function, groups = terms_of(prepared, covariance == "exact"), len(prepared.groups)
    example = [x[:1] for x in (training.q, training.v, training.u)]
    terms = TapedTerms(function, example, groups) if compile else EagerTerms(function, nv, groups)
    compressed = None
    if covariance == "compressed" and groups:
        if not isinstance(latent, ExactPosterior):
            raise InvalidInput(
                "covariance='compressed' needs the factorised covariance of all rows, which a model with a "
                f"{type(latent).__name__} does not have; give covariance='exact', which is the one that it has, "
                f"'none', or {latent.remedy}."
            )
        eager = EagerTerms(terms_of(prepared, True), nv, groups)
        compressed = _compressed(latent, training, prepared, eager, tolerance, largest_rank)
    seconds = time.perf_counter() - begin
    return Predictor(nv, device, latent, prepared, terms, covariance, compressed, widening, seconds)


def _compressed(
    latent: ExactPosterior,
    training: TrainingData,
    prepared: PreparedKernels,
    terms: EagerTerms,
    tolerance: float,
    largest_rank: int,
) -> CompressedCovariance:
    def sample(count: int, seed: int) -> Sample:
        with torch.no_grad():
            at = terms(torch.cat(sample_states(training, count, seed), dim=-1))
        usable = torch.isfinite(at.W).flatten(1).all(1)  # no state of its own has a surface without a normal
        return Sample([z[usable] for z in at.features], at.W[usable])

    latents = [group.latents for group in prepared.groups]
    found = compress(latent, latents, sample(SAMPLES, 0), sample(CHECKS, 1), tolerance=tolerance, largest=largest_rank)
    reached = float(found.inflation.max()) if len(found.inflation) else 0.0
    if reached > tolerance:
        warnings.warn(
            f"rank {found.rank} makes standard deviations up to {reached:.2g} (relative) too large, more than the "
            f"tolerance {tolerance:.2g}; give a larger largest_rank or tolerance, or covariance='exact'.",
            NumericalWarning,
            stacklevel=4,
        )
    return found


def sample_states(training: TrainingData, count: int, seed: int) -> list[Float[Tensor, "count nv"]]:
    """q, v and u of `count` states, a third of each of three kinds.

    Training rows; rows moved by a fraction of the difference of two others; positions, velocities and forces of
    different rows together.
    """
    generator = torch.Generator().manual_seed(seed)
    rows = [training.q, training.v, training.u]

    def some(number: int) -> Tensor:
        return torch.randint(len(training.q), (number,), generator=generator)

    own, apart = count // 3, count - 2 * (count // 3)
    i, j, k = some(own), some(own), some(own)
    mixed = [some(apart) for _ in rows]
    return [
        torch.cat([x[some_rows], x[i] + STEP * (x[j] - x[k]), x[other]])
        for some_rows in [torch.randperm(len(rows[0]), generator=generator)[:own]]
        for x, other in zip(rows, mixed, strict=True)
    ]
