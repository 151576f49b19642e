"""The posterior read backwards: the actuator forces that make a wanted acceleration and normal force."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from forcegp.errors import InvalidInput, NumericalError
from forcegp.integration.newton import find_roots, rows_jacobian
from forcegp.mechanics import Actuation
from forcegp.models.prediction import Gaussian
from forcegp.models.structured.state_forces import StateForces
from forcegp.robots.real_numbers import real_tensor, require_finite


def inverse_dynamics(
    forces: StateForces, q: Tensor, v: Tensor, a: Tensor, normal_force: Any, covariance: bool
) -> Gaussian:
    """u (n, nv) of M a = Q_K(u) + Q_U(u) + A^T lambda at rows of states; what `Predictor.inverse_dynamics` documents.

    u stands on both sides: friction in proportion to the load depends on what presses the robot on the surface, and
    processes may have u among their features. Newton's method solves for it, in one step where neither is so. With the
    processes f of covariance S at that u, and J = d(Q_K + Q_U)/du, u has to first order the covariance
    J^-1 B S B^T J^-T.
    """
    if not forces.known:
        raise InvalidInput(
            "the model has no analytical mean, so its processes hold what u does and u cannot be solved for; fit with "
            "mean='analytical'."
        )
    if not any(isinstance(force, Actuation) for force in forces.system.known_forces):
        raise InvalidInput("no u acts on this system; list Actuation() among its known_forces.")
    multiplier = _multiplier(forces, normal_force, q)

    def residual(u: Tensor) -> Tensor:
        dynamics = forces.dynamics(q, v, u)
        Q_U = forces.latents(dynamics, False).through(forces.prior.mixing(dynamics)).mean
        constraint = (dynamics.A.mT @ multiplier[..., None])[..., 0]
        return dynamics.Q_K + Q_U + constraint - (dynamics.M @ a[..., None])[..., 0]

    with torch.no_grad():
        u, solved = find_roots(residual, torch.zeros_like(q))
        if not bool(solved.all()):
            raise NumericalError(
                f"no u was found that makes the acceleration of state {int((~solved).nonzero()[0])}: friction under "
                "that load takes as much as u adds, or q, v or a is too large; check them, or ask for a smaller "
                "normal_force."
            )
        if not covariance:
            return Gaussian(u, None)
        dynamics = forces.dynamics(q, v, u)
        _, J = rows_jacobian(residual, u)
        spread = torch.linalg.solve(J, forces.prior.mixing(dynamics))
        return Gaussian(u, forces.latents(dynamics, True).through(spread).covariance)


def _multiplier(forces: StateForces, given: Any, q: Tensor) -> Tensor:
    """lambda (n, m), checked."""
    wanted = (len(q), len(forces.system.contacts))
    if given is None:
        return q.new_zeros(wanted)
    value = real_tensor("normal_force", given, q.device).detach()
    if value.shape not in (wanted, wanted[1:]):
        raise InvalidInput(
            f"normal_force has shape {tuple(value.shape)}; give one number for each of the {wanted[1]} contacts, "
            f"({wanted[1]},) or {wanted}, in N."
        )
    require_finite("normal_force", value)
    return value.expand(wanted)
