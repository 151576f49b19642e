"""One step of time of a fitted model, x+ = f(x, u), and its derivatives: what model-predictive control consumes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalError
from forcegp.integration import INTEGRATORS, integrator_named
from forcegp.integration.integrators import ImplicitMidpoint, Integrator, check_time_step
from forcegp.mechanics import MechanicalSystem
from forcegp.models.rollout import AccelerationFunction


class StepLinearization(NamedTuple):
    """The state (q, v) after a step from x = (q, v) under u, and the affine model of the step: x+ = A x + B u + c.

    `q`, `v` (nv,); `A` (2 nv, 2 nv) and `B` (2 nv, nv) are the derivatives in x and u, and `c` (2 nv,) = x+ - A x - B u
    makes the model exact at this x and u. All with the leading dimension of states.
    """

    q: Tensor
    v: Tensor
    A: Tensor
    B: Tensor
    c: Tensor


def stepped(
    mean: AccelerationFunction, system: MechanicalSystem, x: Float[Tensor, "n rows"], dt: Any, integrator: Any
) -> Float[Tensor, "n state"]:
    """[q, v] one step after the rows x = [q, v, u], as `Predictor.step` documents it."""
    method = _method(system, dt, integrator)
    q, v, u = x.chunk(3, dim=-1)
    step = method.step(lambda q, v: mean(q, v, u), q, v, dt)
    if not bool(step.found.all()):
        row = int((~step.found).nonzero()[0])
        raise NumericalError(f"{method.failure} from state {row}; give a dt below {dt:g} s, or check that state.")
    return torch.cat([step.q, step.v], dim=-1)


def linearized_step(
    step: Callable[[Tensor, float, str], Tensor],
    linearize: Callable[[Tensor, Tensor, Tensor], Sequence[Tensor]],
    system: MechanicalSystem,
    x: Float[Tensor, "n rows"],
    dt: Any,
    integrator: Any,
) -> StepLinearization:
    """The same with its derivatives, by the chain rule; of an implicit step by the implicit function theorem.

    `step` gives [q, v] after it from the rows x, `linearize` gives a (n, nv), da/dq, da/dv and da/du (n, nv, nv).
    """
    method, (q, v, u) = _method(system, dt, integrator), x.detach().chunk(3, dim=-1)
    nv, unit = q.shape[-1], torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)

    def joined(value: Tensor, slopes: Tensor) -> Tensor:
        """A value and its derivatives in q, v, u as one row, for explicit steps are linear in these."""
        return torch.cat([value[..., None], slopes.expand(*value.shape, -1)], dim=-1).flatten(1)

    def acceleration(at_q: Tensor, at_v: Tensor) -> Tensor:
        at_q, at_v = (part.unflatten(1, (nv, -1)) for part in (at_q, at_v))
        a, da_dq, da_dv, da_du = linearize(at_q[..., 0], at_v[..., 0], u)
        return joined(a, da_dq @ at_q[..., 1:] + da_dv @ at_v[..., 1:] + da_du @ unit[2 * nv :])

    start_q, start_v = joined(q, unit[:nv]), joined(v, unit[nv : 2 * nv])
    if isinstance(method, ImplicitMidpoint):
        middle = 0.5 * (v + step(x.detach(), dt, integrator)[:, nv:])
        _, da_dq, da_dv, da_du = linearize(q + 0.5 * dt * middle, middle, u)
        J = unit[:nv, :nv] - 0.5 * dt * (da_dv + 0.5 * dt * da_dq)
        right = torch.cat([0.5 * dt * da_dq, unit[:nv, :nv].expand_as(J), 0.5 * dt * da_du], dim=-1)
        at_middle = joined(middle, torch.linalg.solve(J, right))
        end = start_q + dt * at_middle, 2.0 * at_middle - start_v
    else:
        found = method.step(acceleration, start_q, start_v, dt)
        end = found.q, found.v
    there, slopes = torch.cat([part.unflatten(1, (nv, -1)) for part in end], dim=1).split([1, 3 * nv], dim=-1)
    c = there[..., 0] - (slopes @ x.detach()[..., None])[..., 0]
    (q, v), (A, B) = there[..., 0].split(nv, dim=-1), slopes.split([2 * nv, nv], dim=-1)
    return StepLinearization(q, v, A, B, c)


def _method(system: MechanicalSystem, dt: Any, integrator: Any) -> Integrator:
    check_time_step(dt)
    method = integrator_named(integrator, system)
    if integrator == "projected":
        raise InvalidInput(
            "a step is not 'projected': it would move the given state onto the contacts first; give "
            f"{', '.join(map(repr, INTEGRATORS.keys() - {integrator}))}, or roll out with integrator='projected'."
        )
    return method
