"""The posterior read backwards: the actuator forces that make a wanted acceleration and normal force."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalError
from forcegp.integration.integrators import find_roots, rows_jacobian
from forcegp.mechanics import Actuation
from forcegp.models.prediction import Gaussian
from forcegp.robots.real_numbers import real_tensor, require_finite


def inverse_dynamics(posterior: Any, x: Float[Tensor, "n rows"], normal_force: Any, covariance: bool) -> Gaussian:
    """u (n, nv) of M a = Q_K(u) + Q_U(u) + A^T lambda of a StructuredPosterior at rows x = [q, v, a].

    u stands on both sides: friction in proportion to the load changes with what presses the robot onto the surface,
    and processes may have u among their features. Newton's method solves for it, in one step where neither is so. With
    J = d(Q_K + Q_U)/du and the covariance S of the processes, that of u is to first order J^-1 B S B^T J^-T.
    """
    actuated = any(isinstance(force, Actuation) for force in posterior.system.known_forces)
    if posterior.carries_known_forces or not actuated:
        lacks = "analytical mean (fit with mean='analytical')" if actuated else "Actuation() among its known_forces"
        raise InvalidInput(f"this model has no {lacks}, so no u can be solved for; call `predict` or give it one.")
    q, v, a = x.detach().chunk(3, dim=-1)
    shape = (len(q), len(posterior.system.contacts))
    wanted = q.new_zeros(shape) if normal_force is None else real_tensor("normal_force", normal_force, q.device)
    if wanted.shape not in (shape, shape[1:]):
        raise InvalidInput(
            f"normal_force has shape {tuple(wanted.shape)}; give {shape[1:]} or {shape}, one per contact."
        )
    require_finite("normal_force", wanted)

    def surplus(u: Tensor) -> Tensor:
        at = posterior.dynamics(q, v, u)
        Q_U = posterior.latents(at, False).through(posterior.model.prior.mixing(at)).mean
        return at.Q_K + Q_U + (at.A.mT @ wanted[..., None] - at.M @ a[..., None])[..., 0]

    with torch.no_grad():
        u, found = find_roots(surplus, torch.zeros_like(a))
        if not bool(found.all()):
            raise NumericalError(
                f"no u was found that gives row {int((~found).nonzero()[0])} its acceleration: friction takes as much "
                "as u adds, or a number is too large; check q, v, a and normal_force of that row."
            )
        if not covariance:
            return Gaussian(u, None)
        at = posterior.dynamics(q, v, u)
        response = torch.linalg.solve(rows_jacobian(surplus, u)[1], posterior.model.prior.mixing(at))
        return Gaussian(u, posterior.latents(at, True).through(response).covariance)
