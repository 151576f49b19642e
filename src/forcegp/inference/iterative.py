"""The exact posterior mean of all points without their covariance matrix: preconditioned conjugate gradients.

In deflated coordinates T alpha = t with T = sum_c (C_c C_c^T) K_c + I. docs/large-data.md describes products with T and
the preconditioner (`WeightSpace`), docs/solvers.md compares it with others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, NumericalError
from forcegp.inference.dense_kernels import LatentKernels
from forcegp.inference.inducing import Pivots, WeightSpace, pivoted_cholesky, with_left_out
from forcegp.inference.likelihood import Deflation, Terms
from forcegp.inference.posterior import LatentPosterior

Linear = Callable[[Tensor], Tensor]
"""A symmetric positive definite operator on columns (n, S)."""

Iteration = Callable[[int, float], None]
"""Called as report(iteration, largest relative residual)."""

REPLACEMENTS = 3
"""How often the search starts again where the residual it carried along and the true one have drifted apart."""


@dataclass(frozen=True, eq=False)
class Solved:
    """The solution, the iterations that it took and |right - T solution| / |right|, the largest over all columns."""

    solution: Float[Tensor, "n S"]
    iterations: int
    residual: float


def conjugate_gradients(
    apply: Linear,
    precondition: Linear,
    right: Float[Tensor, "n S"],
    *,
    tolerance: float,
    iterations: int,
    start: Float[Tensor, "n S"] | None = None,
    report: Iteration | None = None,
) -> Solved:
    """Solve T x = right to |right - T x| <= tolerance |right| in every column, beginning at `start` or 0.

    What is compared at the end is the true residual, from T itself. Source: Saad (2003), "Iterative methods for sparse
    linear systems", algorithm 9.1.
    Raises NumericalError where the tolerance is not reached in so many iterations, with what was.
    """
    size = torch.linalg.vector_norm(right, dim=0)
    size = torch.where(size > 0, size, torch.ones_like(size))
    x = torch.zeros_like(right) if start is None else start.clone()
    residual = right - apply(x) if start is not None else right.clone()
    done, reached = 0, _largest(residual, size)
    for _ in range(REPLACEMENTS):
        z = precondition(residual)
        direction = z
        rho = (residual * z).sum(0)
        while done < iterations and _largest(residual, size) > tolerance:
            done += 1
            step = apply(direction)
            length = _ratio(rho, (direction * step).sum(0))
            x = x + length * direction
            residual = residual - length * step
            z = precondition(residual)
            previous, rho = rho, (residual * z).sum(0)
            direction = z + _ratio(rho, previous) * direction
            if report is not None:
                report(done, _largest(residual, size))
        residual = right - apply(x)
        reached = _largest(residual, size)
        if reached <= tolerance:
            return Solved(x, done, reached)
        if done >= iterations:
            break
    else:
        raise NumericalError(
            f"conjugate gradients stay at a relative residual of {reached:.1e} after {done} iterations, not "
            f"{tolerance:.0e}: rounding does not let it fall; give a larger tolerance, or raise the noise level."
        )
    raise NumericalError(
        f"conjugate gradients reached a relative residual of {reached:.1e} in {done} iterations, not {tolerance:.0e}; "
        "allow more iterations, give the preconditioner more points, or raise the noise level."
    )


def _largest(residual: Tensor, size: Tensor) -> float:
    relative = torch.linalg.vector_norm(residual, dim=0) / size
    return float(relative.max()) if relative.numel() else 0.0


def _ratio(over: Tensor, under: Tensor) -> Tensor:
    """over / under, 0 for columns that are solved already."""
    return torch.where(
        under != 0, over / torch.where(under != 0, under, torch.ones_like(under)), torch.zeros_like(over)
    )


PANEL_BYTES = 8 * 2**20
"""Largest size of one panel of one latent: it is read twice, and the second time it should still be in the cache."""


class KernelPanels:
    """x -> K_c x_c for all latents c, from the lower triangles of the K_c.

    A panel holds rows start..stop of K_c against columns 0..stop. Those that fit into `memory` bytes are kept from the
    first product on; the others are made again for every product.
    """

    def __init__(self, kernels: LatentKernels, features: Sequence[Float[Tensor, "N _"]], memory: int) -> None:
        self.kernels = kernels.dense
        self.features = features
        self.count = len(features[0])
        self.memory = memory
        self.kept: dict[tuple[int, int], Tensor] = {}
        self.bytes_kept = 0

    def __call__(self, x: Float[Tensor, "C N S"]) -> Float[Tensor, "C N S"]:
        """K_c x_c."""
        out = torch.zeros_like(x)
        start = 0
        while start < self.count:
            stop = min(self.count, start + max(1, PANEL_BYTES // (8 * self.count)))
            for c in range(len(self.kernels)):
                panel = self._panel(c, start, stop)
                out[c, start:stop] += panel @ x[c, :stop]
                out[c, :start] += panel[:, :start].mT @ x[c, start:stop]
            start = stop
        return out

    def release(self) -> None:
        """Give the memory of the panels back; the next product makes them anew."""
        self.kept.clear()
        self.bytes_kept = 0

    def _panel(self, c: int, start: int, stop: int) -> Float[Tensor, "rows stop"]:
        found = self.kept.get((c, start))
        if found is not None:
            return found
        z = self.features[c]
        panel = self.kernels[c].cross(z[start:stop], z[:stop])
        size = panel.numel() * panel.element_size()
        if self.bytes_kept + size <= self.memory:
            self.kept[c, start] = panel
            self.bytes_kept += size
        return panel


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
    ) -> "LowRankPlusDiagonal":
        """With `points` weights for each latent, at greedy pivots."""
        relevance = C.square().sum(1)
        pivots = tuple(
            pivoted_cholesky(kernel, z, relevance[:, c], points)
            for c, (kernel, z) in enumerate(zip(kernels.dense, features, strict=True))
        )
        left_out = torch.stack([found.remainder for found in pivots], dim=-1)
        noise_precision = with_left_out(C, left_out)
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
    ) -> "IterativePosterior":
        """Condition on the data.

        `points` of each latent for the preconditioner, `memory` bytes for kernel matrices that are kept, `start` an
        earlier solution alpha. Raises NumericalError where the tolerance is not reached.
        """
        with torch.no_grad():
            deflation = terms.deflated()
            features = tuple(z.detach() for z in terms.features)
            panels = KernelPanels(kernels, features, memory)
            preconditioner = LowRankPlusDiagonal.of(kernels, features, deflation.C, deflation.t, points)
            if start is not None and start.numel() != deflation.t.numel():
                raise InvalidInput(
                    f"the solution to begin from has {start.numel()} numbers, these rows need {deflation.t.numel()}; "
                    "give that of the same rows, or none."
                )
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


def _covariance_product(C: Float[Tensor, "N r C"], panels: KernelPanels, x: Float[Tensor, "n S"]) -> Tensor:
    """T x, points before outputs."""
    count, rank, _ = C.shape
    given = x.reshape(count, rank, -1)
    mixed = (C.mT @ given).movedim(1, 0).contiguous()  # C N S
    return (C @ panels(mixed).movedim(0, 1) + given).reshape(x.shape)
