"""Newton's method for many small systems r(x) = 0 at once, made for friction: steep, kinked, and not monotone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput

MOST_STEPS, MOST_TRIALS = 200, 12
TOLERANCE = 1e-9
"""x counts as found after a step so small, relative to 1 + |x|."""
SMALLEST_SLOPE = 0.1
"""Smallest real part of an eigenvalue of a Jacobian that is used."""
OVERSHOOT = 0.5

Rows = Callable[[Tensor], Tensor]
"""x (n, k) -> (n, m), each row of its own."""


def find_roots(residual: Rows, x: Float[Tensor, "n k"]) -> tuple[Float[Tensor, "n k"], Bool[Tensor, " n"]]:
    """The roots that Newton's method reaches from x, and where it found them; differentiable once in `residual`'s own.

    A step d is shortened, by the secant rule, where J^-1 r has turned round by more than half at its end: in one
    dimension, where it overshoots the root by more. To ask for a smaller |r|, as textbooks do, ends at bumps of a
    friction curve. A Jacobian with an eigenvalue below `SMALLEST_SLOPE` is shifted: where friction falls with speed,
    the plain step leads away from the root.
    """
    with torch.no_grad():
        x = x.detach()
        found = torch.zeros(len(x), dtype=torch.bool, device=x.device)
        for _ in range(MOST_STEPS):
            r, J = rows_jacobian(residual, x)
            finite = torch.isfinite(r).all(-1) & torch.isfinite(J).flatten(1).all(-1)
            identity = torch.eye(J.shape[-1], dtype=J.dtype, device=J.device)
            J = torch.where(finite[:, None, None], J, identity)
            least = torch.linalg.eigvals(J).real.amin(-1)
            J = J + (SMALLEST_SLOPE - least).clamp_min(0.0)[:, None, None] * identity
            d = torch.where((finite & ~found)[:, None], -_solve(J, r), 0.0)
            small = torch.linalg.vector_norm(d, dim=-1) <= TOLERANCE * (1.0 + torch.linalg.vector_norm(x, dim=-1))
            found |= finite & small
            x = x + (d if bool(small.all()) else _length(residual, x, d, J)[:, None] * d)
            if bool(small.all()):
                break
    if torch.is_grad_enabled() and (r := residual(x)).requires_grad:
        x = _AtRoot.apply(x, rows_jacobian(residual, x)[1], r)  # type: ignore[assignment]  # apply has no types
    return x, found


def rows_jacobian(function: Rows, x: Float[Tensor, "n k"]) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n m k"]]:
    """The value and the Jacobian of a function of rows, by one backward pass for each entry of the value."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        y = function(x)
        rows = [torch.autograd.grad(entry.sum(), x, retain_graph=True)[0] for entry in y.unbind(-1)]
    return y.detach(), torch.stack(rows, dim=-2)


def _length(residual: Rows, x: Tensor, d: Tensor, J: Tensor) -> Float[Tensor, " n"]:
    """The largest fraction tried of each step that does not overshoot."""
    t = torch.ones_like(x[:, 0])
    square = d.square().sum(-1).clamp_min(torch.finfo(d.dtype).tiny)
    for _ in range(MOST_TRIALS):
        ahead = -(d * _solve(J, residual(x + t[:, None] * d))).sum(-1) / square  # 1 at t = 0, < 0 beyond the root
        turned = ~(ahead >= -OVERSHOOT)
        if not bool(turned.any()):
            break
        t = torch.where(turned, t * torch.nan_to_num(1.0 / (1.0 - ahead), 0.1).clamp(0.1, 0.5), t)
    return t


def _solve(J: Tensor, r: Tensor) -> Tensor:
    return torch.linalg.solve_ex(J, r[..., None])[0][..., 0]


class _AtRoot(torch.autograd.Function):
    """x as a function of what r depends on: dx = -J^-1 dr (implicit function theorem)."""

    @staticmethod
    @override
    def forward(ctx: Any, x: Tensor, J: Tensor, r: Tensor) -> Tensor:
        ctx.save_for_backward(J)
        return x.clone()

    @staticmethod
    @override
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, None, Tensor]:  # type: ignore[override]  # as in torch's guide
        if torch.is_grad_enabled():
            raise InvalidInput(
                "an implicit step is differentiable once; leave out create_graph, or take explicit steps."
            )
        return None, None, -_solve(ctx.saved_tensors[0].mT, grads[0])
