"""Newton's method for many small systems r(x) = 0 at once, made for friction: steep, kinked, and not monotone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable
from typing_extensions import override

MOST_STEPS, MOST_TRIALS = 200, 12
TOLERANCE = 1e-9
"""The step after which x counts as found, relative to 1 + |x|: Newton's steps leave an error of about its square."""
SMALLEST_SLOPE = 0.1
"""Smallest real part of an eigenvalue of the Jacobian that is used, where friction without the rest has 1 or more."""
OVERSHOOT = 0.5

Residual = Callable[[Tensor], Tensor]
"""x (n, k) -> r (n, k), each row of its own."""
Slopes = Callable[[Tensor], tuple[Tensor, Tensor]]
"""x (n, k) -> r (n, k) and dr/dx (n, k, k)."""


class Roots(NamedTuple):
    """Where r(x) = 0, and the rows in which it was found."""

    x: Float[Tensor, "n k"]
    converged: Bool[Tensor, " n"]


def find_roots(residual: Residual, x: Float[Tensor, "n k"], slopes: Slopes | None = None) -> Roots:
    """The roots that Newton's method reaches from x, differentiable once in all that `residual` depends on.

    A step along d is accepted where J^-1 r has not turned round by more than half of what it was: in one dimension, as
    long as the root is not overshot by more than that; else it is shortened by the secant rule. Requiring |r| to fall,
    as textbooks do, stops at every bump of a friction curve (3 to 98 of 100 random states of seven joints, where this
    finds all). A Jacobian with an eigenvalue below `SMALLEST_SLOPE` is shifted: where friction falls with speed, the
    plain step leads away from the root. `slopes` gives r and its Jacobian; without, they come from backward passes.
    """
    slopes = slopes or (lambda at: rows_jacobian(residual, at))
    with torch.no_grad():
        x = x.detach()
        identity = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        found = torch.zeros(len(x), dtype=torch.bool, device=x.device)
        for _ in range(MOST_STEPS):
            r, J = _finite(*slopes(x), identity)
            lost = ~torch.isfinite(r).all(-1)
            least = torch.linalg.eigvals(J).real.amin(-1)
            J = J + (SMALLEST_SLOPE - least).clamp_min(0.0)[:, None, None] * identity
            d = -_solve(J, torch.where(lost[:, None], 0.0, r))
            last = ~lost & ~found & (_norm(d) <= TOLERANCE * (1.0 + _norm(x)))
            x = torch.where(last[:, None], x + d, x)
            found |= last
            open_ = ~found & ~lost
            if not bool(open_.any()):
                break
            x = _shortened(residual, x, d, J, open_)
    if torch.is_grad_enabled() and (r := residual(x)).requires_grad:
        x = _AtRoot.apply(x, _finite(*slopes(x), identity)[1], r)  # type: ignore[assignment]  # apply has no types
    return Roots(x, found)


def rows_jacobian(function: Residual, x: Float[Tensor, "n k"]) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m k"]]:
    """The value and the Jacobian of a function of rows, by one backward pass for each entry of the value."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        y = function(x)
        rows = [torch.autograd.grad(entry.sum(), x, retain_graph=True)[0] for entry in y.unbind(-1)]
    return y.detach(), torch.stack(rows, dim=-2)


def _shortened(residual: Residual, x: Tensor, d: Tensor, J: Tensor, open_: Tensor) -> Tensor:
    """x + t d for the open rows, with the largest t tried that does not overshoot."""
    t = torch.ones_like(x[:, 0])
    square = d.square().sum(-1).clamp_min(torch.finfo(d.dtype).tiny)
    for trial in range(MOST_TRIALS):
        at = torch.where(open_[:, None], x + t[:, None] * d, x)
        ahead = -(d * _solve(J, residual(at))).sum(-1) / square  # 1 at t = 0, below 0 beyond the root
        turned = open_ & ~(ahead >= -OVERSHOOT)
        if trial == MOST_TRIALS - 1 or not bool(turned.any()):
            break
        t = torch.where(turned, t * torch.nan_to_num(1.0 / (1.0 - ahead), 0.1).clamp(0.1, 0.5), t)
    return at


def _finite(r: Tensor, J: Tensor, identity: Tensor) -> tuple[Tensor, Tensor]:
    """A derivative that does not exist, as at |0|, counts as that of x itself."""
    return r.detach(), torch.where(torch.isfinite(J).all(-1).all(-1)[:, None, None], J, identity)


def _solve(J: Tensor, r: Tensor) -> Tensor:
    return torch.linalg.solve_ex(J, r[..., None])[0][..., 0]


def _norm(x: Tensor) -> Tensor:
    return torch.linalg.vector_norm(x, dim=-1)


class _AtRoot(torch.autograd.Function):
    """x as a function of what r depends on: dx = -J^-1 dr (implicit function theorem)."""

    @staticmethod
    @override
    def forward(ctx: Any, x: Tensor, J: Tensor, r: Tensor) -> Tensor:
        ctx.save_for_backward(J)
        return x.clone()

    @staticmethod
    @override
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[None, None, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (J,) = ctx.saved_tensors
        return None, None, -_solve(J.mT, grad)
