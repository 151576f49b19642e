"""`Predictor`: a structured posterior prepared for control rates, where a prediction is due every millisecond.

Rigid-body terms, constraints, prior and features become one tape (`tape_tracing`), kernel functions are evaluated for
all processes at once, weights are kept, and the covariance uses few combinations of the data
(`inference.compressed_covariance`).
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalError, NumericalWarning
from forcegp.inference.compressed_covariance import CompressedCovariance, Sample, compress
from forcegp.inference.posterior import ExactPosterior, LatentPosterior
from forcegp.inference.prepared_kernels import PreparedKernels
from forcegp.models.predictor_terms import EagerTerms, TapedTerms, Terms, terms_function
from forcegp.models.sample_states import sample_states
from forcegp.native_code import require_plain

if TYPE_CHECKING:
    from forcegp.models.structured_posterior import StructuredPosterior

COVARIANCES = ("auto", "compressed", "exact", "none")
INSTEAD_OF_TRANSFORMS = (
    "take derivatives by linearize or a backward pass, give many states as rows (n, nv), or make the predictor with "
    "compile=False"
)
BLOCK_NUMBERS = 2**18
"""Kernel values that are worked on at once: 2 MiB, so that they stay in the processor's cache."""

SAMPLES, CHECKS = 300, 150
"""States that choose the compressed covariance, and others that tell how good it is."""


class Linearization(NamedTuple):
    """a(q, v, u) and its derivatives at a state (nv,) or states (n, nv): da_dq[..., i, j] = d a_i / d q_j."""

    a: Tensor
    da_dq: Tensor
    da_dv: Tensor
    da_du: Tensor


@dataclass(frozen=True, eq=False)
class Predictor:
    """The acceleration that a posterior predicts, fast; made by `posterior.predictor()`.

    States are float64 tensors or arrays (nv,) or (n, nv) in the units of `posterior.predict`; results are tensors with
    the same leading dimension. They are those of `predict`: means to rounding, covariances exactly or never below, as
    `kind` says. Differentiable once in q, v and u where these are tensors that require gradients; with `compile=False`
    any number of times, also forward and by `torch.func`, but for `vmap`: give it all states as rows.

    `kind` is that of the covariance, "compressed", "exact" or "none"; `rank` and `inflation` tell how it was
    compressed; `prepare_seconds` is what preparing took, the C++ compiler included, which runs once per process.

    Raises InvalidInput for wrong shapes, for values that are not finite and where derivatives would be lost,
    NumericalError where the result is not finite.
    """

    __no_type_check__: ClassVar[bool] = True

    nv: int
    device: torch.device
    latent: LatentPosterior
    prepared: PreparedKernels
    tape: TapedTerms | EagerTerms
    kind: str
    compressed: CompressedCovariance | None
    prepare_seconds: float

    @property
    def rank(self) -> int | None:
        """How many combinations of the data the covariance uses; None unless it is compressed."""
        return None if self.compressed is None else self.compressed.rank

    @property
    def inflation(self) -> Tensor | None:
        """Standard deviations over the exact ones, minus 1, at states that did not choose the compression."""
        return None if self.compressed is None else self.compressed.inflation

    def mean(self, q: Any, v: Any, u: Any) -> Tensor:
        """The mean acceleration (nv,) or (n, nv) in rad/s^2 or m/s^2."""
        x, single = self._rows(q, v, u)
        return _finished([self._mean(self.tape(part))[0] for part in self._blocks(x)], single)

    def __call__(self, q: Any, v: Any, u: Any) -> tuple[Tensor, Tensor]:
        """Mean (nv,) and covariance (nv, nv) of the acceleration, or (n, nv) and (n, nv, nv); without noise.

        Raises InvalidInput where the predictor was made with covariance="none".
        """
        if self.kind == "none":
            raise InvalidInput("this predictor has no covariance; make it with covariance='compressed' or 'exact'.")
        x, single = self._rows(q, v, u)
        means, covariances = [], []
        for part in self._blocks(x):
            terms = self.tape(part)
            mean, cross = self._mean(terms, keep=self.kind == "compressed")
            means.append(mean)
            covariances.append(terms.W @ self._covariance(terms, cross) @ terms.W.mT)
        return _finished(means, single), _finished(covariances, single)

    def linearize(self, q: Any, v: Any, u: Any) -> Linearization:
        """The mean acceleration and its Jacobians in q, v and u, without a graph."""
        x, single = self._rows(q, v, u)
        require_plain([x], "linearize", "take derivatives of `mean` instead, of a predictor with compile=False")
        parts = [self._linearize(part.detach()) for part in self._blocks(x)]
        a, jacobian = (_finished([part[k] for part in parts], single) for k in (0, 1))
        return Linearization(a, *jacobian.split(self.nv, dim=-1))

    def _mean(self, terms: Terms, keep: bool = False) -> tuple[Tensor, list[Tensor]]:
        if not terms.W.shape[-1]:
            return terms.offset, []
        f, cross = self.prepared.mean(terms.inputs, keep)
        return terms.offset + (terms.W @ f[..., None])[..., 0], cross

    def _covariance(self, terms: Terms, cross: list[Tensor]) -> Tensor:
        """Of the latents, (n, C, C)."""
        if not terms.W.shape[-1]:
            return terms.W.new_zeros(len(terms.W), 0, 0)
        if self.compressed is None:
            return self.latent.covariance(terms.features)
        P = self.prepared.ordered(self.compressed.roots(cross))
        return torch.diag_embed(self.prepared.diagonal(terms.inputs)) - P @ P.mT

    def _linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        terms, slopes = self.tape.with_jacobians(x)
        if not terms.W.shape[-1]:
            return terms.offset, slopes.offset
        f, df = self.prepared.mean_and_slopes(terms.inputs, slopes.inputs)
        a = terms.offset + (terms.W @ f[..., None])[..., 0]
        return a, slopes.offset + (f[:, None, None] @ slopes.W)[:, :, 0] + terms.W @ df

    def _rows(self, q: Any, v: Any, u: Any) -> tuple[Tensor, bool]:
        """One row [q, v, u] per state, and whether it was a single state."""
        states = [
            x.to(torch.float64) if isinstance(x, Tensor) else torch.tensor(np.array(x, np.float64), device=self.device)
            for x in (q, v, u)
        ]
        shape = states[0].shape
        if shape[-1:] != (self.nv,) or len(shape) > 2 or any(x.shape != shape for x in states):
            shapes = ", ".join(f"{name} {tuple(x.shape)}" for name, x in zip("qvu", states, strict=True))
            raise InvalidInput(
                f"a predictor was given {shapes}; give all three ({self.nv},) for one state or (n, {self.nv})."
            )
        if any(x.device.type != self.device.type for x in states):
            raise InvalidInput(f"q, v or u is on another device than the predictor; move all three to {self.device}.")
        x = torch.cat(states, dim=-1)
        if isinstance(self.tape, TapedTerms):
            require_plain([x], "a compiled predictor", INSTEAD_OF_TRANSFORMS)
        if not math.isfinite(float(x.detach().sum())):
            raise InvalidInput("q, v or u has values that are not finite; a predictor needs finite states.")
        return (x[None], True) if len(shape) == 1 else (x, False)

    def _blocks(self, x: Tensor) -> Sequence[Tensor]:
        return (x,) if len(x) <= self._block_rows else x.split(self._block_rows)

    @cached_property
    def _block_rows(self) -> int:
        return max(1, BLOCK_NUMBERS // max(1, sum(len(centers) for centers in self.latent.features)))


def _finished(blocks: list[Tensor], single: bool) -> Tensor:
    values = blocks[0] if len(blocks) == 1 else torch.cat(blocks)
    if not math.isfinite(float(values.detach().sum())):
        raise NumericalError(
            "the predicted acceleration is not finite: the mass matrix is singular there, or a surface has no normal; "
            "MechanicalSystem.check_states names the row and the contact."
        )
    return values[0] if single else values


def make_predictor(
    posterior: StructuredPosterior, covariance: str, tolerance: float, largest_rank: int, compile: bool
) -> Predictor:
    """What `StructuredPosterior.predictor` documents."""
    if covariance not in COVARIANCES:
        raise InvalidInput(f"covariance is {covariance!r}; give one of {', '.join(map(repr, COVARIANCES))}.")
    if not (0.0 < tolerance < math.inf and isinstance(largest_rank, int) and largest_rank >= 1):
        raise InvalidInput(
            f"tolerance is {tolerance!r} and largest_rank is {largest_rank!r}; give a positive number, for example "
            "0.01, and an integer from 1."
        )
    if posterior.model.noise is not None and posterior.model.noise.measured_torque:
        raise InvalidInput(
            "a predictor is for commanded torques, and this model was told that u comes from a noisy sensor; call "
            "predict, or fit with Noise(..., measured_torque=False)."
        )
    begin = time.perf_counter()
    latent, nv = posterior.latent, posterior.system.robot.nv
    if covariance == "auto":
        covariance = "compressed" if isinstance(latent, ExactPosterior) else "exact"
    prepared = PreparedKernels.of(latent, compile)
    function, groups = terms_function(posterior, prepared, covariance == "exact"), len(prepared.groups)
    example = [x[:1] for x in (posterior.training.q, posterior.training.v, posterior.training.u)]
    terms = TapedTerms(function, example, groups) if compile else EagerTerms(function, nv, groups)
    compressed = None
    if covariance == "compressed" and groups:
        compressed = _compressed(posterior, prepared, tolerance, largest_rank)
    seconds = time.perf_counter() - begin
    return Predictor(nv, posterior.system.robot.device, latent, prepared, terms, covariance, compressed, seconds)


def _compressed(
    posterior: StructuredPosterior, prepared: PreparedKernels, tolerance: float, largest_rank: int
) -> CompressedCovariance:
    latent = posterior.latent
    if not isinstance(latent, ExactPosterior):
        raise InvalidInput(
            "covariance='compressed' needs the factorised covariance of all rows, which a model with a "
            f"{type(latent).__name__} does not have; give covariance='exact', which is the one that it has, or 'none', "
            f"or {latent.remedy}."
        )
    terms = EagerTerms(terms_function(posterior, prepared, True), posterior.system.robot.nv, len(prepared.groups))

    def sample(count: int, seed: int) -> Sample:
        with torch.no_grad():
            at = terms(torch.cat(sample_states(posterior.training, count, seed), dim=-1))
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
