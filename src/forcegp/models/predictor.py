"""`Predictor`: a posterior prepared for control rates, where a prediction is due every millisecond.

Rigid-body terms, constraints, prior and features become one tape (`codegen.tape_tracing`), kernel functions are
evaluated for all processes at once, weights are kept, and the covariance uses few combinations of the data
(`inference.compressed_covariance`). `structured.predictor_preparation` makes one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from forcegp.codegen.native_code import require_plain
from forcegp.errors import InvalidInput, NumericalError
from forcegp.inference.compressed_covariance import CompressedCovariance
from forcegp.inference.posterior import LatentPosterior
from forcegp.inference.prepared_kernels import PreparedKernels
from forcegp.models.discrete_steps import StepLinearization, linearized_step, stepped
from forcegp.models.prediction import Gaussian
from forcegp.models.predictor_terms import EagerTerms, PredictorTerms, TapedTerms
from forcegp.models.structured.components import Components
from forcegp.models.structured.inverse_dynamics import inverse_dynamics
from forcegp.robots.real_numbers import real_tensor, require_finite
from forcegp.summary import Summary

INSTEAD_OF_TRANSFORMS = (
    "take derivatives by linearize or a backward pass, give many states as rows (n, nv), or make the predictor with "
    "compile=False"
)
BLOCK_NUMBERS = 2**18
"""Kernel values that are worked on at once: 2 MiB, so that they stay in the processor's cache."""


class Linearization(NamedTuple):
    """a(q, v, u) and its derivatives at a state (nv,) or states (n, nv): da_dq[..., i, j] = d a_i / d q_j."""

    a: Tensor
    da_dq: Tensor
    da_dv: Tensor
    da_du: Tensor


@dataclass(frozen=True, eq=False, repr=False)
class Predictor(Summary):
    """The acceleration that a posterior predicts, fast; made by `posterior.predictor()`.

    States are float64 tensors or arrays (nv,) or (n, nv) in the units of `posterior.predict`; results are tensors with
    the same leading dimension. They are those of `predict`: means to rounding, covariances exactly or never below, as
    `kind` says. Differentiable once in q, v and u where these are tensors that require gradients; with `compile=False`
    any number of times, also forward and by `torch.func`, but for `vmap`: give it all states as rows.

    `kind` is that of the covariance, "compressed", "exact" or "none"; `rank` and `inflation` describe how it was
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
    widening: float
    prepare_seconds: float
    posterior: Any = None  # what it was made of, by which forces and inverse dynamics are computed

    def facts(self) -> dict[str, object]:
        """What it predicts, and how long preparing took."""
        covariance = {"joints": self.nv, "covariance": self.kind, "device": self.device}
        return {**covariance, "prepared in": f"{self.prepare_seconds:.2g} s"}

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

    def step(self, q: Any, v: Any, u: Any, dt: float, integrator: str = "symplectic-euler") -> tuple[Tensor, Tensor]:
        """The state (q, v) `dt` seconds later under constant u, each (nv,) or (n, nv); differentiable as `mean`.

        `integrator` is "symplectic-euler", "rk4" or "implicit-midpoint" (docs/rollouts.md), which is differentiable
        once. Raises InvalidInput for "projected", other names and a dt that is no positive number, NumericalError where
        an implicit step is not found.
        """
        x, single = self._rows(q, v, u)
        state = stepped(self.mean, self.posterior.system, x, dt, integrator)
        q, v = (state[0] if single else state).split(self.nv, dim=-1)
        return q, v

    def linearize_step(
        self, q: Any, v: Any, u: Any, dt: float, integrator: str = "symplectic-euler"
    ) -> StepLinearization:
        """That state and the affine model x+ = A x + B u + c of the step, x = (q, v), without a graph."""
        x, single = self._rows(q, v, u)
        linear = linearized_step(self.mean, self.posterior.system, x, dt, integrator)
        return StepLinearization(*(part[0] for part in linear)) if single else linear

    def forces(self, q: Any, v: Any, u: Any, *, covariance: bool = True) -> Components:
        """Unknown force, multipliers, contact force and every component of the prior, with exact covariances."""
        self._rows(q, v, u)
        return self.posterior.components(q, v, u, covariance=covariance)

    def inverse_dynamics(self, q: Any, v: Any, a: Any, normal_force: Any = None) -> Gaussian:
        """The actuator forces u (nv,) or (n, nv) in Nm or N that make the acceleration a (rad/s^2 or m/s^2).

        u = M a + h - A^T lambda - Q_U with the known forces -h: friction under load is that of this lambda, which
        `normal_force` (m,) or (n, m) gives in N, positive where the surface pushes the robot off, as in
        `predict(...).multiplier`; None is 0. The covariance is that of Q_U at u, to first order, and None for a
        predictor without one. `a` has to obey A a = b, else the contacts change it. Results have no graph.
        Raises InvalidInput for models without analytical mean or actuation, NumericalError where no u is found.
        """
        x, single = self._rows(q, v, a, "qva")
        found = inverse_dynamics(self.posterior, x, normal_force, self.kind != "none")
        return found[0] if single else found

    def _mean(self, terms: PredictorTerms, keep: bool = False) -> tuple[Tensor, list[Tensor]]:
        if not terms.W.shape[-1]:
            return terms.offset, []
        f, cross = self.prepared.mean(terms.inputs, keep)
        return terms.offset + (terms.W @ f[..., None])[..., 0], cross

    def _covariance(self, terms: PredictorTerms, cross: list[Tensor]) -> Tensor:
        """Of the latents, (n, C, C)."""
        if not terms.W.shape[-1]:
            return terms.W.new_zeros(len(terms.W), 0, 0)
        if self.compressed is None:
            return self.widening**2 * self.latent.covariance(terms.features)
        P = self.prepared.ordered(self.compressed.roots(cross))
        return self.widening**2 * (torch.diag_embed(self.prepared.diagonal(terms.inputs)) - P @ P.mT)

    def _linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        terms, slopes = self.tape.with_jacobians(x)
        if not terms.W.shape[-1]:
            return terms.offset, slopes.offset
        f, df = self.prepared.mean_and_slopes(terms.inputs, slopes.inputs)
        a = terms.offset + (terms.W @ f[..., None])[..., 0]
        return a, slopes.offset + (f[:, None, None] @ slopes.W)[:, :, 0] + terms.W @ df

    def _rows(self, q: Any, v: Any, u: Any, names: str = "qvu") -> tuple[Tensor, bool]:
        """One row [q, v, u] per state, and whether it was a single state."""
        states = [real_tensor(name, x, self.device) for name, x in zip(names, (q, v, u), strict=True)]
        shape, named = states[0].shape, f"q, v or {names[2]}"
        if shape[-1:] != (self.nv,) or len(shape) > 2 or any(x.shape != shape for x in states):
            shapes = ", ".join(f"{name} {tuple(x.shape)}" for name, x in zip(names, states, strict=True))
            raise InvalidInput(
                f"a predictor was given {shapes}; give all three ({self.nv},) for one state or (n, {self.nv})."
            )
        if any(x.device.type != self.device.type for x in states):
            raise InvalidInput(f"{named} is on another device than the predictor; move all three to {self.device}.")
        x = torch.cat(states, dim=-1)
        if isinstance(self.tape, TapedTerms):
            require_plain([x], "a compiled predictor", INSTEAD_OF_TRANSFORMS)
        require_finite(named, x)
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
