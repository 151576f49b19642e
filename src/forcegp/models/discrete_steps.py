"""One step of time of a fitted model, x+ = f(x, u), and its derivatives: what model-predictive control consumes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalError, unknown_name_message
from forcegp.integration import ImplicitMidpoint, Integrator, RungeKutta4, Step, SymplecticEuler

STEPS: dict[str, type[Integrator]] = {
    "symplectic-euler": SymplecticEuler,
    "rk4": RungeKutta4,
    "implicit-midpoint": ImplicitMidpoint,
}
"""The integrators that are a function of one state."""

Slopes = Callable[[Tensor, Tensor, Tensor], Sequence[Tensor]]
"""(q, v, u), each (n, nv) -> a (n, nv) and da/dq, da/dv, da/du (n, nv, nv)."""


class StepLinearization(NamedTuple):
    """The step from a state x = (q, v) under u, and the affine model of it there: x+ = A x + B u + c.

    `q`, `v` (nv,) are the state after the step, `A` (2 nv, 2 nv) and `B` (2 nv, nv) its derivatives in x and u, and
    `c` (2 nv,) = x+ - A x - B u, so that the model is exact at this x and u; all with the leading dimension of states.
    """

    q: Tensor
    v: Tensor
    A: Tensor
    B: Tensor
    c: Tensor


def stepped(
    mean: Callable[[Tensor, Tensor, Tensor], Tensor], slopes: Slopes, x: Sequence[Tensor], dt: Any, integrator: Any
) -> Step:
    """The step of states x = [q, v, u], each (n, nv); refusals as `linearized_step`."""
    q, v, u = x
    method = _method(dt, integrator)
    if isinstance(method, ImplicitMidpoint):
        method = ImplicitMidpoint(lambda q, v: tuple(slopes(q, v, u.detach())[:3]))  # type: ignore[arg-type]  # three of four
    step = method.step(lambda q, v: mean(q, v, u), q, v, dt)
    if step.solved is not None and not bool(step.solved.all()):
        raise NumericalError(
            f"the implicit step of state {int((~step.solved).nonzero()[0])} has no solution that Newton's method "
            f"finds; give a smaller dt than {dt:g} s, or check q, v and u of that state."
        )
    return step


def linearized_step(
    mean: Callable[[Tensor, Tensor, Tensor], Tensor], slopes: Slopes, x: Sequence[Tensor], dt: Any, integrator: Any
) -> StepLinearization:
    """The step of states x = [q, v, u], each (n, nv), with derivatives by the chain rule.

    Raises InvalidInput for a step that is no positive number and for integrators that are no smooth function of the
    state, NumericalError where an implicit step is not found.
    """
    method, (q, v, u) = _method(dt, integrator), (part.detach() for part in x)
    n, nv = q.shape
    unit = torch.eye(3 * nv, dtype=q.dtype, device=q.device).expand(n, -1, -1)

    def jet(value: Tensor, derivative: Tensor) -> Tensor:
        """A value and its derivatives in q, v, u side by side, as one row, which explicit methods treat alike."""
        return torch.cat([value[..., None], derivative], dim=-1).flatten(1)

    def parts(of: Tensor) -> tuple[Tensor, Tensor]:
        columns = of.unflatten(1, (nv, -1))
        return columns[..., 0], columns[..., 1:]

    def acceleration(jet_q: Tensor, jet_v: Tensor) -> Tensor:
        (at_q, dq), (at_v, dv) = parts(jet_q), parts(jet_v)
        a, da_dq, da_dv, da_du = slopes(at_q, at_v, u)
        return jet(a, da_dq @ dq + da_dv @ dv + da_du @ unit[:, 2 * nv :])

    begin_q, begin_v = jet(q, unit[:, :nv]), jet(v, unit[:, nv : 2 * nv])
    if isinstance(method, ImplicitMidpoint):
        middle = 0.5 * (v + stepped(mean, slopes, (q, v, u), dt, integrator).v)
        _, da_dq, da_dv, da_du = slopes(q + 0.5 * dt * middle, middle, u)
        J = unit[:, :nv, :nv] - 0.5 * dt * (da_dv + 0.5 * dt * da_dq)
        right = torch.cat([0.5 * dt * da_dq, unit[:, :nv, :nv], 0.5 * dt * da_du], dim=-1)
        at_middle = jet(middle, torch.linalg.solve(J, right))  # implicit function theorem
        end_q, end_v = begin_q + dt * at_middle, 2.0 * at_middle - begin_v
    else:
        step = method.step(acceleration, begin_q, begin_v, dt)
        end_q, end_v = step.q, step.v
    (q_next, dq), (v_next, dv) = parts(end_q), parts(end_v)
    A, B = torch.cat([dq, dv], dim=-2).split([2 * nv, nv], dim=-1)
    here, there = torch.cat([q, v], dim=-1), torch.cat([q_next, v_next], dim=-1)
    c = there - (A @ here[..., None] + B @ u[..., None])[..., 0]
    return StepLinearization(q_next, v_next, A, B, c)


def _method(dt: Any, integrator: Any) -> Integrator:
    if not isinstance(dt, int | float) or isinstance(dt, bool) or not (math.isfinite(dt) and dt > 0.0):
        raise InvalidInput(f"dt is {dt!r}; give the time step as a positive number of seconds.")
    if integrator == "projected":
        raise InvalidInput(
            "a step cannot be 'projected': that search for a state on the contacts is made by rollouts only; give "
            f"{', '.join(map(repr, STEPS))}, or call posterior.rollout(..., integrator='projected')."
        )
    if not isinstance(integrator, str) or integrator not in STEPS:
        raise InvalidInput(unknown_name_message("integrator", str(integrator), "a step", STEPS, cutoff=0.4))
    return STEPS[integrator]()
