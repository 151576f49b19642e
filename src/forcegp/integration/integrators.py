"""Steps of time, whose accelerations a(q, v) may come from anywhere, and motions of many states (n, nv) by them."""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, NumericalWarning, require_known, require_number
from forcegp.model import Model
from forcegp.robots.manifold import ConfigurationSpace

MOST_STEPS, MOST_TRIALS = 200, 12
TOLERANCE = 1e-9  # x counts as found after a step so small, relative to 1 + |x|
SMALLEST_SLOPE = 0.1  # smallest real part of an eigenvalue of a Jacobian that is used
OVERSHOOT = 0.5

Rows = Callable[[Tensor], Tensor]
"""x (n, k) -> (n, m), each row of its own."""


def find_roots(residual: Rows, x: Float[Tensor, "n k"]) -> tuple[Float[Tensor, "n k"], Bool[Tensor, " n"]]:
    """The roots that Newton's method reaches from x, and where it found them; differentiable once in `residual`'s own.

    A step is shortened, by the secant rule, where J^-1 r has turned round by more than half at its end; a smaller |r|
    ends at bumps of a friction curve. J with an eigenvalue below `SMALLEST_SLOPE` is shifted: where friction falls with
    speed, the plain step leads away from the root.
    """
    with torch.no_grad():
        x = x.detach()
        found = torch.zeros(len(x), dtype=torch.bool, device=x.device)
        for _ in range(MOST_STEPS):
            r, J = rows_jacobian(residual, x)
            finite = torch.isfinite(r).all(-1) & torch.isfinite(J).flatten(1).all(-1)
            identity = torch.eye(J.shape[-1], dtype=J.dtype, device=J.device)
            J = torch.where(finite[:, None, None], J, identity)
            try:
                least = torch.linalg.eigvals(J).real.amin(-1)
            except torch.linalg.LinAlgError:  # LAPACK may fail where eigenvalues repeat; this one is never larger
                least = torch.linalg.eigvalsh(0.5 * (J + J.mT)).amin(-1)
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


def rows_jacobian(function: Rows, x: Float[Tensor, "*n k"]) -> tuple[Float[Tensor, "*n m"], Float[Tensor, "*n m k"]]:
    """The value and the Jacobian of a function of rows, by one backward pass for each entry of the value."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        y = function(x)
        rows = [torch.autograd.grad(entry.sum(), x, retain_graph=True)[0] for entry in y.unbind(-1)]
    return y.detach(), torch.stack(rows, dim=-2)


def _length(residual: Rows, x: Tensor, d: Tensor, J: Tensor) -> Float[Tensor, " n"]:
    """The largest fraction tried of each step that does not overshoot."""
    t, square = torch.ones_like(x[:, 0]), d.square().sum(-1).clamp_min(torch.finfo(d.dtype).tiny)
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
            raise InvalidInput("an implicit step is differentiable once; leave out create_graph, or step explicitly.")
        return None, None, -_solve(ctx.saved_tensors[0].mT, grads[0])


Acceleration = Callable[[Tensor, Tensor], Tensor]
"""(q, v), each (n, nv), -> a (n, nv)."""


@dataclass(frozen=True, eq=False)
class Step:
    """The state after one step, the acceleration at its beginning, and whether there is such a state (`NO_ROOT`)."""

    q: Float[Tensor, "n nq"]
    v: Float[Tensor, "n nv"]
    a: Float[Tensor, "n nv"]
    found: Bool[Tensor, " n"]


Integrator = Callable[[Acceleration, Tensor, Tensor, float], Step]
"""(acceleration, q, v, dt) -> the state `dt` seconds later, by a one-step method for v' = a(q, v) in some space.

There q' = v or, on a manifold, v is the velocity in body axes, and steps are those of Lie group methods.
"""
VECTORS = ConfigurationSpace(0)  # positions that add up; their number does not matter
NO_ROOT = "Newton's method found no solution of the implicit step"  # why a step can have no end


def symplectic_euler(space: ConfigurationSpace, acceleration: Acceleration, q: Tensor, v: Tensor, dt: float) -> Step:
    """v+ = v + dt a(q, v), q+ = q + dt v+: first order, one evaluation; what PyBullet and Rath et al. (2021) do."""
    a = acceleration(q, v)
    v = v + dt * a
    return Step(space.integrate(q, dt * v), v, a, _all(q))


def rk4(space: ConfigurationSpace, acceleration: Acceleration, q: Tensor, v: Tensor, dt: float) -> Step:
    """The classical method of fourth order, four evaluations (Hairer, Norsett & Wanner 1993, table II.1.2).

    On a manifold in the chart of the exponential (Munthe-Kaas 1999).
    """

    def rates(step: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
        return space.chart_velocity(step, at), acceleration(space.integrate(q, step), at)

    a1 = acceleration(q, v)
    r2, a2 = rates(0.5 * dt * v, v + 0.5 * dt * a1)
    r3, a3 = rates(0.5 * dt * r2, v + 0.5 * dt * a2)
    r4, a4 = rates(dt * r3, v + dt * a3)
    q_next = space.integrate(q, dt / 6.0 * (v + 2.0 * r2 + 2.0 * r3 + r4))
    return Step(q_next, v + dt / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4), a1, _all(q))


def implicit_midpoint(space: ConfigurationSpace, acceleration: Acceleration, q: Tensor, v: Tensor, dt: float) -> Step:
    """v_m = v + dt/2 a(q + dt/2 v_m, v_m), v+ = 2 v_m - v, q+ = q + dt v_m: second order, for stiff friction.

    A-stable and symplectic (Hairer, Lubich & Wanner 2006, II.1.3), by Newton's method. On manifolds q+ = q exp(dt v_m).
    """

    def moved(at: Tensor, share: float) -> Tensor:
        return space.integrate(q, share * dt * at)

    middle, found = find_roots(lambda at: at - v - 0.5 * dt * acceleration(moved(at, 0.5), at), v)
    return Step(moved(middle, 1.0), 2.0 * middle - v, acceleration(q, v), found)


INTEGRATORS: dict[str, Callable[..., Step]] = {
    "symplectic-euler": symplectic_euler,
    "rk4": rk4,
    "implicit-midpoint": implicit_midpoint,
}
"""Methods, whose first argument is the space, by the name that rollouts and the command line use."""


def integrator_named(name: str, model: Model) -> Integrator:
    """The integrator of that name for motions of `model`. Raises InvalidInput for any other name."""
    require_known("integrator", name, "forcegp", INTEGRATORS, cutoff=0.4)
    return partial(INTEGRATORS[name], model.robot.space)


def check_time_step(dt: Any) -> None:
    """Raise InvalidInput for what is no positive number."""
    require_number("dt", dt, "give the time step as a positive number of seconds")


def steps_by(name: str, model: Model, dt: Any) -> Integrator:
    """The integrator of that name for steps of `dt` s. Raises InvalidInput for another, and no positive number."""
    check_time_step(dt)
    return integrator_named(name, model)


def _all(q: Tensor) -> Tensor:
    device = getattr(q, "device", None)  # expressions of CasADi, which take explicit steps, have none
    return torch.ones(q.shape[0], dtype=torch.bool, device=device)


SPEED_LIMIT = 1000.0  # a motion with a joint faster than this (rad/s or m/s) has diverged: motors turn that fast


Feedback = Callable[[int, Tensor, Tensor], Tensor]
"""(k, q, v) -> what a controller adds to u[k], of the shape of u; asked once per step, at the state where it begins."""


class Trajectory(NamedTuple):
    """Motions of T steps: q, v (..., T+1, nv), a (..., T, nv) at the beginning of each step, in rad (m) and s.

    `diverged_at` (...) is the row from which on a motion is NaN because it diverged, -1 if it lasted to the end;
    `not_found` those the integrator could not carry on. `integrate` has the steps first: (T+1, n, nv).
    """

    q: Tensor
    v: Tensor
    a: Tensor
    diverged_at: Tensor
    not_found: Tensor


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
) -> Trajectory:
    """Carry n states through T steps of `dt` seconds; u[k] + feedback(k, q[k], v[k]) acts from row k to row k + 1.

    A motion that is no longer finite, faster than `SPEED_LIMIT`, or that the integrator cannot carry on, is NaN from
    there, and a NumericalWarning names `what`. `acceleration` and `feedback` see finite states only. Differentiable
    in q0, v0, u and what `feedback` adds. InvalidInput for a dt that is no positive number or a start beyond the limit.
    """
    check_start(v0, dt)

    def guarded(u: Tensor, q0: Tensor, v0: Tensor, q: Tensor, v: Tensor) -> Tensor:
        """a(q, v) under u, NaN at states that are not finite: models are asked at (q0, v0) in their place."""
        finite = torch.isfinite(q).all(-1, keepdim=True) & torch.isfinite(v).all(-1, keepdim=True)
        if bool(finite.all()):
            return acceleration(q, v, u)
        return torch.where(finite, acceleration(torch.where(finite, q, q0), torch.where(finite, v, v0), u), math.nan)

    q, v = q0, v0
    steps, n = u.shape[:2]
    rows_q, rows_v, rows_a = [q], [v], []  # stacked in the end, which keeps the graph where there is one
    diverged_at = torch.full((n,), -1, dtype=torch.int64, device=q.device)
    not_found = torch.zeros(n, dtype=torch.bool, device=q.device)
    alive = torch.ones(n, dtype=torch.bool, device=q.device)
    for k in range(steps):
        step = integrator(partial(guarded, u[k] + (0.0 if feedback is None else feedback(k, q, v)), q, v), q, v, dt)
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
    warn_of_divergence(diverged_at, not_found, dt, what)
    return Trajectory(torch.stack(rows_q), torch.stack(rows_v), torch.stack(rows_a), diverged_at, not_found)


def check_start(v0: Tensor, dt: float) -> None:
    """Raise InvalidInput where `dt` is no positive number or a start is faster than the limit."""
    check_time_step(dt)
    if bool((v0.abs() > SPEED_LIMIT).any()):
        seen = f"v0 has a joint velocity of {float(v0.abs().max()):.3g}"
        advice = f"a motion faster than {SPEED_LIMIT:g} rad/s or m/s counts as diverged, check its units."
        raise InvalidInput(f"{seen}; {advice}")


def warn_of_divergence(diverged_at: Tensor, not_found: Tensor, dt: float, what: str) -> None:
    """A NumericalWarning of those that ended."""
    ended = diverged_at >= 0
    if not bool(ended.any()):
        return
    first, lost = int(diverged_at[ended].min()), int(not_found.sum())
    cause = f"a joint faster than {SPEED_LIMIT:g} rad/s or m/s, or a state that is not finite"
    if lost:
        cause = NO_ROOT + (f" ({lost} of them), or {cause}" if lost < int(ended.sum()) else "")
    first_at = f"the first at step {first} ({first * dt:.4g} s)"
    seen = f"{int(ended.sum())} of {len(diverged_at)} {what} diverged, {first_at}: {cause}"
    advice = "a smaller dt, a shorter motion or a model with more physics avoids this."
    warnings.warn(f"{seen}. They are NaN from there on; {advice}", NumericalWarning, stacklevel=3)
