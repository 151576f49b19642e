"""One step of time of a fitted model, x+ = f(x, u), and its derivatives: what model-predictive control consumes."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalError
from forcegp.integration import INTEGRATORS, integrator_named
from forcegp.integration.integrators import check_time_step, rows_jacobian
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
    check_time_step(dt)
    method = integrator_named(integrator, system)
    if integrator == "projected":
        raise InvalidInput(
            "a step is not 'projected': it would move the given state onto the contacts first; give "
            f"{', '.join(map(repr, INTEGRATORS.keys() - {integrator}))}, or roll out with integrator='projected'."
        )
    q, v, u = x.chunk(3, dim=-1)
    step = method.step(lambda q, v: mean(q, v, u), q, v, dt)
    if not bool(step.found.all()):
        row = int((~step.found).nonzero()[0])
        raise NumericalError(f"{method.failure} from state {row}; give a dt below {dt:g} s, or check that state.")
    return torch.cat([step.q, step.v], dim=-1)


def linearized_step(
    mean: AccelerationFunction, system: MechanicalSystem, x: Float[Tensor, "n rows"], dt: Any, integrator: Any
) -> StepLinearization:
    """The same with its derivatives, by backward passes through the step."""
    there, slopes = rows_jacobian(lambda at: stepped(mean, system, at, dt, integrator), x)
    c = there - (slopes @ x.detach()[..., None])[..., 0]
    nv = x.shape[-1] // 3
    (q, v), (A, B) = there.split(nv, dim=-1), slopes.split([2 * nv, nv], dim=-1)
    return StepLinearization(q, v, A, B, c)
