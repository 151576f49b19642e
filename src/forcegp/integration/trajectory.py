"""`integrate`: many motions at once, each until its end or until it diverges.

A motion that diverges is a result, not an error that would take the others along: models without physics do diverge,
and figures compare them.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalWarning
from forcegp.integration.integrators import Acceleration, Integrator, check_time_step

SPEED_LIMIT = 100.0
"""A motion with a joint faster than this (rad/s or m/s) has diverged: no robot moves so fast."""


Feedback = Callable[[int, Tensor, Tensor], Tensor]
"""(k, q, v) -> what a controller adds to u[k], of the shape of u; asked once per step, at the state where it begins."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """n motions of T steps: q, v (T+1, n, nv) and a (T, n, nv), the acceleration at the beginning of each step.

    `diverged_at` (n,) is the first row of q and v that does not exist (NaN from there on), -1 for a motion that lasted
    to the end; `not_found` marks those that the integrator could not carry on.
    """

    q: Float[Tensor, "rows n nq"]
    v: Float[Tensor, "rows n nv"]
    a: Float[Tensor, "steps n nv"]
    diverged_at: Int[Tensor, " n"]
    not_found: Bool[Tensor, " n"]


def integrate(
    integrator: Integrator,
    acceleration: Callable[[Tensor, Tensor, Tensor], Tensor],
    q0: Float[Tensor, "n nq"],
    v0: Float[Tensor, "n nv"],
    u: Float[Tensor, "steps n nu"],
    dt: float,
    *,
    feedback: Feedback | None = None,
    what: str = "motions",
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Carry n states through T steps of `dt` seconds; u[k] + feedback(k, q[k], v[k]) acts from row k to row k + 1.

    Like u, what the feedback adds is constant over a step (a zero-order hold), whatever states the integrator visits
    on the way: so it is asked once per step, of finite states only.

    A motion whose state is no longer finite, that is faster than `SPEED_LIMIT`, or that the integrator cannot carry on
    (`Integrator.failure`), ends there: the rest of it is NaN, `diverged_at` holds the row, and a NumericalWarning is
    given. The others go on. `acceleration` is called with finite states only. `what` names the motions in the warning,
    `progress(step, steps)` is called after every step. Differentiable in q0, v0, u and what `feedback` adds.
    Raises InvalidInput where `dt` is no positive number or a start is faster than the limit.
    """
    check_start(v0, dt)
    q, v = integrator.start(q0, v0)
    steps, n = u.shape[:2]
    rows_q, rows_v, rows_a = [q], [v], []  # stacked in the end, which keeps the graph where there is one
    diverged_at = torch.full((n,), -1, dtype=torch.int64, device=q.device)
    not_found = torch.zeros(n, dtype=torch.bool, device=q.device)
    alive = torch.ones(n, dtype=torch.bool, device=q.device)
    for k in range(steps):
        forces = u[k] if feedback is None else u[k] + feedback(k, q, v)
        step = integrator.step(_at_finite_states(acceleration, q, v, forces), q, v, dt)
        rows_a.append(torch.where(alive[:, None], step.a, math.nan))
        bounded = (step.v.abs() <= SPEED_LIMIT).all(-1) & torch.isfinite(step.q).all(-1)  # NaN compares as false
        good = alive & bounded & step.found
        if not bool(good.all()):
            ended = alive & ~good
            diverged_at[ended] = k + 1
            not_found |= ended & ~step.found
            alive = good
        # A motion that has ended stays where it last was: there its acceleration can be computed.
        q, v = torch.where(good[:, None], step.q, q), torch.where(good[:, None], step.v, v)
        for rows, x in ((rows_q, q), (rows_v, v)):
            rows.append(torch.where(good[:, None], x, math.nan))
        if not bool(alive.any()):
            for rows in (rows_q, rows_v, rows_a):
                rows += [torch.full_like(rows[-1], math.nan)] * (steps - k - 1)
            break
        if progress is not None:
            progress(k + 1, steps)
    warn_of_divergence(diverged_at, not_found, integrator.failure, dt, what)
    return Trajectory(torch.stack(rows_q), torch.stack(rows_v), torch.stack(rows_a), diverged_at, not_found)


def check_start(v0: Tensor, dt: float) -> None:
    """Raise InvalidInput where `dt` is no positive number or a start is faster than the limit."""
    check_time_step(dt)
    if bool((v0.abs() > SPEED_LIMIT).any()):
        raise InvalidInput(
            f"v0 has a joint velocity of {float(v0.abs().max()):.3g}; a motion faster than {SPEED_LIMIT:g} rad/s or "
            "m/s counts as diverged, check its units."
        )


def _at_finite_states(
    acceleration: Callable[[Tensor, Tensor, Tensor], Tensor], q0: Tensor, v0: Tensor, u: Tensor
) -> Acceleration:
    """a(q, v) under u, which is NaN at states that are not finite: models are asked at (q0, v0) in their place."""

    def guarded(q: Tensor, v: Tensor) -> Tensor:
        finite = torch.isfinite(q).all(-1, keepdim=True) & torch.isfinite(v).all(-1, keepdim=True)
        if bool(finite.all()):
            return acceleration(q, v, u)
        return torch.where(finite, acceleration(torch.where(finite, q, q0), torch.where(finite, v, v0), u), math.nan)

    return guarded


def warn_of_divergence(diverged_at: Tensor, not_found: Tensor, failure: str, dt: float, what: str) -> None:
    """A NumericalWarning of those that ended."""
    ended = diverged_at >= 0
    if not bool(ended.any()):
        return
    first = int(diverged_at[ended].min())
    lost = int(not_found.sum())
    cause = f"a joint faster than {SPEED_LIMIT:g} rad/s or m/s, or a state that is not finite"
    if lost:
        cause = failure + (f" ({lost} of them), or {cause}" if lost < int(ended.sum()) else "")
    warnings.warn(
        f"{int(ended.sum())} of {len(diverged_at)} {what} diverged, the first at step {first} ({first * dt:.4g} s): "
        f"{cause}. They are NaN from there on; a smaller dt, a shorter motion or a model with more physics "
        "avoids this.",
        NumericalWarning,
        stacklevel=3,
    )
