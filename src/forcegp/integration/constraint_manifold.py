"""`ConstraintManifold`: the states at which all contacts hold, and the projections of q and v onto it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from forcegp.errors import NumericalError
from forcegp.mechanics import MechanicalSystem
from forcegp.mechanics.gauss_principle import REDUNDANCY_TOLERANCE, factors
from forcegp.robots import Kinematics

POSITION_TOLERANCE = 1e-12
"""A position counts as on the surface within this distance, |c| / |s_p|, in m."""
MOST_ITERATIONS = 25


@dataclass(frozen=True, eq=False)
class ProjectedPosition:
    """Positions q with c(q) = 0 (where `converged`), A at them, L^-1 of M = L L^T at the given q, and iterations."""

    q: Float[Tensor, "n nv"]
    A: Float[Tensor, "n m nv"]
    inverse_lower: Float[Tensor, "n nv nv"]
    converged: Bool[Tensor, " n"]
    iterations: int


@dataclass(frozen=True, eq=False)
class ConstraintManifold:
    """{(q, v): c(q) = 0, A(q) v = 0} of the contacts of a system; everything, if it has none.

    Distances are measured by the mass matrix, |dq|_M^2 = dq^T M dq, so that corrections act along M^-1 A^T like the
    contact forces themselves. Redundant contacts are legal: all inverses of A M^-1 A^T are pseudo-inverses.
    """

    system: MechanicalSystem

    def violation(
        self, q: Float[Tensor, "*batch nv"], v: Float[Tensor, "*batch nv"]
    ) -> tuple[Float[Tensor, "*batch m"], Float[Tensor, "*batch m"]]:
        """c(q) in m and A(q) v in m/s, for surfaces that are signed distances."""
        c, A, _ = self._constraint(self.system.robot.kinematics(q))
        return c, (A @ v[..., None])[..., 0]

    def project_position(self, q: Float[Tensor, "n nv"]) -> ProjectedPosition:
        """The positions on all surfaces that Newton's method finds from q: dq = -M^-1 A^T (A M^-1 A^T)^+ c, M fixed.

        Source: Hairer, Lubich & Wanner (2006), Geometric Numerical Integration, sections IV.4 and VII.1.4, with the
        gradients renewed in every iteration. Converged means |c| <= 1e-12 m |s_p| in all contacts: 1e-12 m from the
        surface, whatever the scale of the function that describes it (|s_p| = 1 for signed distances). States that do
        not converge are returned as such, for the caller to judge.
        """
        given_finite = torch.isfinite(q).all(-1)
        q = torch.where(given_finite[:, None], q, 0.0)
        kinematics = self.system.robot.kinematics(q)
        _, inverse_lower = factors(self.system.mass_matrix(kinematics))
        iteration, differentiable = 0, torch.is_grad_enabled() and q.requires_grad
        while True:
            c, A, slope = self._constraint(kinematics)
            on_surface = (c.abs() <= POSITION_TOLERANCE * slope).all(-1)
            finite = torch.isfinite(A).all(-1).all(-1) & torch.isfinite(c).all(-1) & given_finite
            moving = ~on_surface & finite
            if iteration == MOST_ITERATIONS or not bool(moving.any()):
                if not differentiable:
                    return ProjectedPosition(q, A, inverse_lower, on_surface & finite, iteration)
                # one step more, of rounding's size: without one, a q on the surface would have the derivative 1
                moving, differentiable = on_surface & finite, False
            A_white = torch.where(finite[:, None, None], A @ inverse_lower.mT, 0.0)
            white = _pseudo_inverse(A_white) @ torch.where(finite[:, None], c, 0.0)[..., None]
            q = torch.where(moving[:, None], q - (inverse_lower.mT @ white)[..., 0], q)
            kinematics = self.system.robot.kinematics(q)
            iteration += 1

    def project_velocity(self, at: ProjectedPosition, v: Float[Tensor, "n nv"]) -> Float[Tensor, "n nv"]:
        """The nearest velocity with A v = 0 there: v - M^-1 A^T (A M^-1 A^T)^+ A v."""
        rate = (at.A @ v[..., None])[..., 0]
        finite = torch.isfinite(at.A).all(-1).all(-1) & torch.isfinite(rate).all(-1)
        A_white = torch.where(finite[:, None, None], at.A @ at.inverse_lower.mT, 0.0)
        inverse = _pseudo_inverse(A_white)
        for _ in range(2):  # the second time removes what rounding of the first has left
            v = v - (at.inverse_lower.mT @ (inverse @ (at.A @ v[..., None])))[..., 0]
        return v

    def project(
        self, q: Float[Tensor, "n nv"], v: Float[Tensor, "n nv"]
    ) -> tuple[Float[Tensor, "n nv"], Float[Tensor, "n nv"]]:
        """Both. Raises NumericalError, naming the state, where no position on all surfaces is found near q."""
        at = self.project_position(q)
        if not bool(at.converged.all()):
            row = int(torch.nonzero(~at.converged)[0])
            c, _ = self.violation(at.q[row], v[row])
            raise NumericalError(
                f"state {row} cannot be moved onto the surfaces of the contacts: after {at.iterations} Newton steps "
                f"|c| is still {float(c.abs().max()):.2e} m. Start nearer to the surfaces, check that the robot can "
                "reach them and that the contacts do not contradict each other, or use an integrator that does not "
                "project."
            )
        return at.q, self.project_velocity(at, v)

    def _constraint(self, kinematics: Kinematics) -> tuple[Tensor, Tensor, Tensor]:
        """c (..., m), A (..., m, nv) and |s_p| (..., m)."""
        batch, nv = kinematics.batch_shape, self.system.robot.nv
        contacts = self.system.contacts
        if not contacts:
            empty = kinematics.twists.new_zeros(*batch, 0)
            return empty, kinematics.twists.new_zeros(*batch, 0, nv), empty
        values, rows, slopes = [], [], []
        for contact in contacts:
            p = contact.position(kinematics)
            gradient = contact.surface.gradient(p)
            J = kinematics.frame_jacobian(contact.frame, contact.point)[..., :3, :]
            values.append(contact.surface.value(p))
            rows.append((gradient[..., None, :] @ J)[..., 0, :])
            slopes.append(torch.linalg.vector_norm(gradient, dim=-1))
        return torch.stack(values, dim=-1), torch.stack(rows, dim=-2), torch.stack(slopes, dim=-1)


def _pseudo_inverse(A_white: Tensor) -> Tensor:
    """(A L^-T)^+: for a single contact a division, which is much faster than the general case."""
    if A_white.shape[-2] == 1:
        square = A_white.square().sum(-1, keepdim=True)
        return torch.where(square > 0.0, A_white / square, 0.0).mT
    return torch.linalg.pinv(A_white, rtol=REDUNDANCY_TOLERANCE) if A_white.shape[-2] else A_white.mT
