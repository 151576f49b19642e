"""The exact posterior mean of all points without their covariance matrix: preconditioned conjugate gradients.

In deflated coordinates T alpha = t with T = sum_c (C_c C_c^T) K_c + I. A product with T needs the kernel matrices one
panel after the other; the preconditioner is the covariance of the same model with a few weights per latent and the rest
of the prior variance as noise of every point (`weight_space`), inverted by Woodbury's identity. docs/solvers.md
compares it with others: a pivoted Cholesky factor of T is as good where its rank is chosen well, but gives no
covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput
from forcegp.inference.conjugate_gradients import Iteration, Solved, conjugate_gradients
from forcegp.inference.deflation import Deflation
from forcegp.inference.kernel_panels import KernelPanels
from forcegp.inference.kernels import LatentKernels
from forcegp.inference.pivots import Pivots, pivoted_cholesky
from forcegp.inference.posterior import LatentPosterior
from forcegp.inference.terms import Terms
from forcegp.inference.weight_space import WeightSpace


@dataclass(frozen=True, eq=False)
class LowRankPlusDiagonal:
    """P = Phi Phi^T + D ~ T, and its inverse: D^-1 - D^-1 Phi B^-1 Phi^T D^-1 (Woodbury)."""

    C: Float[Tensor, "N r C"]
    pivots: tuple[Pivots, ...]
    noise_precision: Float[Tensor, "N r r"]
    weights: WeightSpace

    @classmethod
    def of(
        cls,
        kernels: LatentKernels,
        features: Sequence[Float[Tensor, "N _"]],
        C: Float[Tensor, "N r C"],
        t: Float[Tensor, "N r"],
        points: int,
    ) -> LowRankPlusDiagonal:
        """With `points` weights for each latent, at greedy pivots."""
        relevance = C.square().sum(1)
        pivots = tuple(
            pivoted_cholesky(kernel, z, relevance[:, c], points)
            for c, (kernel, z) in enumerate(zip(kernels.dense, features, strict=True))
        )
        left_out = torch.stack([found.remainder for found in pivots], dim=-1)
        identity = torch.eye(C.shape[1], dtype=C.dtype, device=C.device)
        D = (C * left_out[:, None, :]) @ C.mT + identity
        noise_precision = torch.cholesky_inverse(torch.linalg.cholesky(D))
        places = [z[found.indices] for z, found in zip(features, pivots, strict=True)]
        weights = WeightSpace.of(kernels, features, places, C, t, noise_precision)
        return cls(C, pivots, noise_precision, weights)

    def solve(self, x: Float[Tensor, "n S"]) -> Float[Tensor, "n S"]:
        """P^-1 x."""
        count, rank, _ = self.C.shape
        y = self.noise_precision @ x.reshape(count, rank, -1)
        Cy = (self.C.mT @ y).movedim(1, 0).contiguous()  # C N S
        right = torch.cat([found.rows @ Cy[c] for c, found in enumerate(self.pivots)])
        weights = self.weights.precision.solve(right)
        back = [found.rows.mT @ weights[part] for found, part in zip(self.pivots, self.weights.slices, strict=True)]
        return (y - self.noise_precision @ (self.C @ torch.stack(back, dim=1))).reshape(x.shape)


@dataclass(frozen=True, eq=False)
class IterativePosterior(LatentPosterior):
    """The posterior from conjugate gradients: mean to `tolerance`, covariance from the preconditioner's model.

    That model has the same prior variance at every point, but keeps only `points` weights per latent in common between
    points; drawn functions are those of the exact posterior, and vary less where the weights are few.
    `solve_covariance=True` takes conjugate gradients for the covariance, too: as good as the mean, and as expensive for
    every few points as the whole fit.
    """

    kernels: LatentKernels
    features: tuple[Float[Tensor, "N _"], ...]
    deflation: Deflation
    panels: KernelPanels
    preconditioner: LowRankPlusDiagonal
    solved: Solved
    tolerance: float
    iterations: int
    solve_covariance: bool = False
    beta: Float[Tensor, "N C"] = field(init=False)

    def __post_init__(self) -> None:
        alpha = self.solved.solution.reshape(self.deflation.t.shape)
        object.__setattr__(self, "beta", torch.einsum("irc,ir->ic", self.deflation.C, alpha))

    @classmethod
    def condition(
        cls,
        kernels: LatentKernels,
        terms: Terms,
        *,
        points: int,
        tolerance: float,
        iterations: int,
        memory: int,
        solve_covariance: bool = False,
        start: Float[Tensor, "n 1"] | None = None,
        report: Iteration | None = None,
    ) -> IterativePosterior:
        """Condition on the data.

        `points` of each latent for the preconditioner, `memory` bytes for kernel matrices that are kept, `start` an
        earlier solution alpha. Raises NumericalError where the tolerance is not reached.
        """
        with torch.no_grad():
            deflation = terms.deflated()
            features = tuple(z.detach() for z in terms.features)
            panels = KernelPanels(kernels, features, memory)
            preconditioner = LowRankPlusDiagonal.of(kernels, features, deflation.C, deflation.t, points)
            _check_start(start, deflation)
            solved = conjugate_gradients(
                lambda x: _covariance_product(deflation.C, panels, x),
                preconditioner.solve,
                deflation.t.reshape(-1, 1),
                tolerance=tolerance,
                iterations=iterations,
                start=start,
                report=report,
            )
            panels.release()
        return cls(
            kernels, features, deflation, panels, preconditioner, solved, tolerance, iterations, solve_covariance
        )

    @property
    @override
    def weights(self) -> tuple[Float[Tensor, " N"], ...]:
        return self.beta.unbind(-1)

    @override
    def covariance(self, features: Sequence[Float[Tensor, "n _"]]) -> Float[Tensor, "n C C"]:
        if not self.solve_covariance:
            return self.preconditioner.weights.covariance(features)
        # k_c(z, z) delta_cd - v_c^T T^-1 v_d with v_c = [k_c(z, z_j) C_jac], all points in one search
        v = torch.stack([self._data_columns(c, z) for c, z in enumerate(features)], dim=1)
        explained = torch.einsum("kcn,kdn->ncd", v, self.solve(v.flatten(1)).view_as(v))
        prior = [kernel.diagonal(z) for kernel, z in zip(self.kernels.dense, features, strict=True)]
        return torch.diag_embed(torch.stack(prior, dim=-1)) - explained

    @override
    def variance_of(self, index: int, z: Float[Tensor, "n _"]) -> Float[Tensor, " n"]:
        if not self.solve_covariance:
            return self.preconditioner.weights.variance_of(index, z)
        v = self._data_columns(index, z)
        return self.kernels.dense[index].diagonal(z) - (v * self.solve(v)).sum(0)

    def _data_columns(self, index: int, z: Float[Tensor, "n _"]) -> Float[Tensor, "_ n"]:
        """Covariance of the deflated data with one latent at points."""
        return self.deflation.columns(index, self.kernels.dense[index].cross(z, self.features[index]))

    @override
    def function_weights(
        self, prior: Sequence[Float[Tensor, "S N"]], generator: torch.Generator
    ) -> tuple[Float[Tensor, "S N"], ...]:
        return self.deflation.drawn_weights(prior, generator, self.solve)  # all functions in one search

    def solve(self, right: Float[Tensor, "n S"]) -> Float[Tensor, "n S"]:
        """T^-1 right, to the same tolerance. Raises NumericalError where it is not reached."""
        try:
            return conjugate_gradients(
                lambda x: _covariance_product(self.deflation.C, self.panels, x),
                self.preconditioner.solve,
                right,
                tolerance=self.tolerance,
                iterations=self.iterations,
            ).solution
        finally:
            self.panels.release()


def _check_start(start: Tensor | None, deflation: Deflation) -> None:
    if start is not None and start.numel() != deflation.t.numel():
        raise InvalidInput(
            f"the solution to begin from has {start.numel()} numbers, these rows need {deflation.t.numel()}; give that "
            "of the same rows, or none."
        )


def _covariance_product(C: Float[Tensor, "N r C"], panels: KernelPanels, x: Float[Tensor, "n S"]) -> Tensor:
    """T x, points before outputs."""
    count, rank, _ = C.shape
    given = x.reshape(count, rank, -1)
    mixed = (C.mT @ given).movedim(1, 0).contiguous()  # C N S
    return (C @ panels(mixed).movedim(0, 1) + given).reshape(x.shape)
