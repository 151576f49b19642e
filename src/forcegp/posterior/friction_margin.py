"""How far feet and tools are from slipping: the margin to the friction cone, with the uncertainty of the forces.

With the force F on the robot at a foot, its part N along the normal and T across it, a foot holds while

    margin = mu N - |T| >= 0    (Coulomb).

The posterior makes F normal with a full covariance. |T| is not, so moments and P(margin < 0) are those of `POINTS`
draws of F at low-discrepancy points (Sobol, scrambled), the same for all states.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import ContactError, InvalidInput, usable_arguments
from forcegp.forces.contact_friction import ContactFriction
from forcegp.mechanics import ConstrainedDynamics, Held, LoopClosure, RollingContact, surface_axes
from forcegp.posterior.posterior import Array, Posterior
from forcegp.posterior.prediction import Gaussian

POINTS = 2048
"""Probabilities are multiples of 1 / POINTS, with errors of about that size."""


@dataclass(frozen=True, eq=False)
class FrictionMargins:
    """Margins to slipping (..., feet) of the feet called `names`, in N; NaN where a foot does not stand.

    Names are those of their links, with the switch in brackets where a link has several feet.

    `mean` and `std` of mu N - |T|; `slip` the probability that it is negative; `force` (..., 3) is that on the foot
    along two tangents and the normal, by foot.
    """

    names: tuple[str, ...]
    mean: Float[Tensor, "*batch feet"]
    std: Float[Tensor, "*batch feet"]
    slip: Float[Tensor, "*batch feet"]
    force: Mapping[str, Gaussian]


@usable_arguments("friction_margins")
def friction_margins(
    posterior: Posterior,
    q: Array,
    v: Array,
    u: Array,
    coefficient: float,
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> FrictionMargins:
    """Margins of all feet at states as for `predict`: contacts of one link that act together are one foot.

    `coefficient` is the friction coefficient mu of the ground; `normal` its normal at points that are held, world axes
    (surfaces have their own). Friction that a `ContactFriction` of the prior adds at a contact counts to its force.
    Raises ContactError without contacts with the world, InvalidInput for models without forces and a negative mu.
    """
    if posterior.carries_known_forces:
        raise InvalidInput(f"{posterior.description} predicts no contact forces; fit one with an analytical mean.")
    contacts = posterior.model.contacts
    feet: dict[tuple[str, str | None], list[int]] = {}
    for index, contact in enumerate(contacts):
        if not isinstance(contact, LoopClosure):
            feet.setdefault((contact.frame, contact.switch), []).append(index)
    if not feet:
        raise ContactError("the system has no contact with the world, so nothing can slip; list its contacts.")
    if isinstance(coefficient, bool) or not isinstance(coefficient, int | float) or not 0.0 <= coefficient < math.inf:
        raise InvalidInput(f"the friction coefficient is {coefficient!r}; give a number of at least 0.")
    states, batch = posterior.checked_states(q, v, u)
    with torch.no_grad():
        dynamics = posterior.dynamics(*(x.reshape(*batch, x.shape[-1]) for x in states))
        forces = _forces(posterior, dynamics, feet.values(), torch.tensor(Held(normal).normal))
        moments = [margin_moments(force, coefficient) for force in forces]
        # a contact that does not act, or that a plane base holds, has a row of zeros
        stands = dynamics.A[..., [rows[0] for rows in feet.values()], :].abs().amax(-1) > 1e-9
        mean, std, slip = (torch.stack(part, -1).masked_fill(~stands, torch.nan) for part in zip(*moments, strict=True))
    frames = [frame for frame, _ in feet]
    names = tuple(frame if frames.count(frame) == 1 else f"{frame} ({switch})" for frame, switch in feet)
    return FrictionMargins(names, mean, std, slip, dict(zip(names, forces, strict=True)))


def margin_moments(force: Gaussian, mu: float) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and standard deviation of mu N - |T|, and P(mu N < |T|), of forces (..., 3) along T_1, T_2 and N."""
    assert force.covariance is not None, "margins need the covariance"
    uniform = torch.quasirandom.SobolEngine(3, scramble=True, seed=0).draw(POINTS, dtype=torch.float64)
    normal = torch.special.ndtri(uniform.clamp(1e-12, 1.0 - 1e-12)).to(force.mean)
    values, vectors = torch.linalg.eigh(force.covariance)
    root = vectors * values.clamp_min(0.0).sqrt()[..., None, :]
    F = force.mean[..., None, :] + normal @ root.mT
    margin = mu * F[..., 2] - torch.linalg.vector_norm(F[..., :2], dim=-1)
    return margin.mean(-1), margin.std(-1), (margin < 0.0).to(margin).mean(-1)


def _forces(
    posterior: Posterior, dynamics: ConstrainedDynamics, feet: Collection[list[int]], normal: Tensor
) -> list[Gaussian]:
    """Force (..., 3) on every foot along t1, t2 and n, friction of the prior at its contacts included."""
    prior, model = posterior.trained.unknown, posterior.model
    affine = dynamics.contact_force_map()
    offset = affine.offset.unflatten(-1, (-1, 3))  # (..., m, 3)
    effect = (affine.matrix @ prior.direction(dynamics)).unflatten(-2, (-1, 3))  # (..., m, 3, C)
    for _, term, which in prior.named(model.robot):
        if isinstance(term, ContactFriction) and term.contact < len(model.contacts):
            point = term.point_force(dynamics)
            effect = effect.clone()
            effect[..., term.contact, :, which] += point
    latents, forces = posterior.latents(dynamics, True), []
    for rows in feet:
        gradient = dynamics.normals[..., rows[0], :]
        first = model.contacts[rows[0]]  # of a wheel, that along its normal
        if isinstance(first.surface, Held) and not isinstance(first, RollingContact):
            gradient = normal.to(gradient).expand_as(gradient)
        turn = surface_axes(gradient).mT
        known = (turn @ offset[..., rows, :].sum(-2)[..., None])[..., 0]
        forces.append(latents.through(turn @ effect[..., rows, :, :].sum(-3), known))
    return forces
