"""Preconditioned conjugate gradients for several right-hand sides at once; a missed tolerance is an error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import NumericalError

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
