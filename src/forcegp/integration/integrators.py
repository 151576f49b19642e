"""One step of time: symplectic Euler, Runge-Kutta, implicit midpoint, and a scheme that stays on the constraint.

An integrator asks for accelerations a(q, v) wherever they come from; actuator forces are constant
over the step. All states are batched, (n, nv).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, NumericalError, require_known
from forcegp.mechanics.gauss_principle import REDUNDANCY_TOLERANCE, factors
from forcegp.model import Model
from forcegp.robots import Kinematics
from forcegp.robots.manifold import ConfigurationSpace

POSITION_TOLERANCE = 1e-12
"""A position counts as on the surface within this distance, |c| / |s_p|, in m."""
MOST_ITERATIONS = 25


@dataclass(frozen=True, eq=False)
class ProjectedPosition:
    """Positions q with c(q) = 0 (where `converged`), A at them, L^-1 of M = L L^T at the given q, and iterations."""

    q: Float[Tensor, "n nq"]
    A: Float[Tensor, "n m nv"]
    inverse_lower: Float[Tensor, "n nv nv"]
    converged: Bool[Tensor, " n"]
    iterations: int


@dataclass(frozen=True, eq=False)
class ConstraintManifold:
    """{(q, v): c(q) = 0, A(q) v = 0} of the contacts of a model; everything, if it has none.

    Distances are measured by the mass matrix, |dq|_M^2 = dq^T M dq, so that corrections act along M^-1 A^T like the
    contact forces themselves. Redundant contacts are legal: all inverses of A M^-1 A^T are pseudo-inverses.
    """

    model: Model

    def violation(
        self, q: Float[Tensor, "*batch nq"], v: Float[Tensor, "*batch nv"]
    ) -> tuple[Float[Tensor, "*batch m"], Float[Tensor, "*batch m"]]:
        """c(q) in m and A(q) v in m/s, for surfaces that are signed distances; NaN where q is."""
        space = self.model.robot.space
        lost = None if space.is_vector_space else torch.isnan(q).any(-1, keepdim=True)
        if lost is not None:  # no quaternion is made of NaN
            q = torch.where(lost, space.neutral().to(q), q)
        c, A, _ = self._constraint(self.model.robot.kinematics(q))
        rate = (A @ v[..., None])[..., 0]
        return (c, rate) if lost is None else (c.masked_fill(lost, torch.nan), rate.masked_fill(lost, torch.nan))

    def project_position(self, q: Float[Tensor, "n nq"]) -> ProjectedPosition:
        """The positions on all surfaces that Newton's method finds from q: dq = -M^-1 A^T (A M^-1 A^T)^+ c, M fixed.

        Source: Hairer, Lubich & Wanner (2006), Geometric Numerical Integration, sections IV.4 and VII.1.4, with the
        gradients renewed in every iteration. Converged means |c| <= 1e-12 m |s_p| in all contacts: 1e-12 m from the
        surface, whatever the scale of the function that describes it (|s_p| = 1 for signed distances). States that do
        not converge are returned as such, for the caller to judge.
        """
        space = self.model.robot.space
        given_finite = torch.isfinite(q).all(-1)
        q = torch.where(given_finite[:, None], q, space.neutral().to(q.device) if space.groups else 0.0)
        kinematics = self.model.loaded_robot.kinematics(q)
        _, inverse_lower = factors(self.model.mass_matrix_at(kinematics))
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
            q = torch.where(moving[:, None], space.integrate(q, -(inverse_lower.mT @ white)[..., 0]), q)
            kinematics = self.model.robot.kinematics(q)
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
        self, q: Float[Tensor, "n nq"], v: Float[Tensor, "n nv"]
    ) -> tuple[Float[Tensor, "n nq"], Float[Tensor, "n nv"]]:
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
        batch, nv = kinematics.batch_shape, self.model.robot.nv
        contacts = self.model.contacts
        if not contacts:
            empty = kinematics.twists.new_zeros(*batch, 0)
            return empty, kinematics.twists.new_zeros(*batch, 0, nv), empty
        values, rows, slopes = [], [], []
        for contact in contacts:
            value, A, gradient, _ = contact.row(kinematics)
            values.append(value)
            rows.append(A)
            slopes.append(torch.linalg.vector_norm(gradient, dim=-1))
        return torch.stack(values, dim=-1), torch.stack(rows, dim=-2), torch.stack(slopes, dim=-1)


def _pseudo_inverse(A_white: Tensor) -> Tensor:
    """(A L^-T)^+: for a single contact a division, which is much faster than the general case."""
    if A_white.shape[-2] == 1:
        square = A_white.square().sum(-1, keepdim=True)
        return torch.where(square > 0.0, A_white / square, 0.0).mT
    return torch.linalg.pinv(A_white, rtol=REDUNDANCY_TOLERANCE) if A_white.shape[-2] else A_white.mT


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


Acceleration = Callable[[Tensor, Tensor], Tensor]
"""(q, v), each (n, nv), -> a (n, nv)."""


@dataclass(frozen=True, eq=False)
class Step:
    """The state after one step, the acceleration at its beginning, and whether there is such a state (`failure`)."""

    q: Float[Tensor, "n nq"]
    v: Float[Tensor, "n nv"]
    a: Float[Tensor, "n nv"]
    found: Bool[Tensor, " n"]


class Integrator(ABC):
    """A one-step method for v' = a(q, v), where q' = v or, on a manifold, v is the velocity in body axes."""

    space: ConfigurationSpace
    """How positions change; on a manifold steps are those of Lie group methods."""
    failure: ClassVar[str] = ""
    """Why a step can have no end, for a warning."""

    def start(
        self, q: Float[Tensor, "n nq"], v: Float[Tensor, "n nv"]
    ) -> tuple[Float[Tensor, "n nq"], Float[Tensor, "n nv"]]:
        """The state at which a motion from (q, v) begins: itself, unless the method needs another."""
        return q, v

    @abstractmethod
    def step(self, acceleration: Acceleration, q: Float[Tensor, "n nq"], v: Float[Tensor, "n nv"], dt: float) -> Step:
        """The state `dt` seconds later."""


VECTORS = ConfigurationSpace(0)
"""Positions that add up; their number does not matter."""


@dataclass(frozen=True, eq=False)
class SymplecticEuler(Integrator):
    """v+ = v + dt a(q, v), q+ = q + dt v+: first order, one evaluation; what PyBullet and Rath et al. (2021) do."""

    space: ConfigurationSpace = VECTORS

    @override
    def step(self, acceleration: Acceleration, q: Tensor, v: Tensor, dt: float) -> Step:
        a = acceleration(q, v)
        v = v + dt * a
        return Step(self.space.integrate(q, dt * v), v, a, _all(q))


@dataclass(frozen=True, eq=False)
class RungeKutta4(Integrator):
    """The classical method of fourth order, four evaluations (Hairer, Norsett & Wanner 1993, table II.1.2).

    On a manifold for the step from q in the chart of the exponential (Munthe-Kaas 1999; Hairer, Lubich & Wanner 2006,
    section IV.8.2), of the same order.
    """

    space: ConfigurationSpace = VECTORS

    @override
    def step(self, acceleration: Acceleration, q: Tensor, v: Tensor, dt: float) -> Step:
        def rates(step: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
            return self.space.chart_velocity(step, at), acceleration(self.space.integrate(q, step), at)

        a1 = acceleration(q, v)
        r2, a2 = rates(0.5 * dt * v, v + 0.5 * dt * a1)
        r3, a3 = rates(0.5 * dt * r2, v + 0.5 * dt * a2)
        r4, a4 = rates(dt * r3, v + dt * a3)
        q_next = self.space.integrate(q, dt / 6.0 * (v + 2.0 * r2 + 2.0 * r3 + r4))
        return Step(q_next, v + dt / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4), a1, _all(q))


@dataclass(frozen=True, eq=False)
class ImplicitMidpoint(Integrator):
    """v_m = v + dt/2 a(q + dt/2 v_m, v_m), v+ = 2 v_m - v, q+ = q + dt v_m: second order, for stiff friction.

    Gauss' method of one stage, A-stable and symplectic (Hairer, Lubich & Wanner 2006, II.1.3), by Newton's method, for
    which torch has to be able to differentiate the acceleration. On a manifold by
    the Cayley transform, with which a tumbling body in free fall keeps its energy and momentum exactly.
    """

    space: ConfigurationSpace = VECTORS
    failure = "Newton's method found no solution of the implicit step"

    @override
    def step(self, acceleration: Acceleration, q: Tensor, v: Tensor, dt: float) -> Step:
        half = 0.5 * dt

        def moved(at: Tensor, share: float) -> Tensor:
            return self.space.integrate(q, share * self.space.midpoint_step(dt * at))

        def residual(at: Tensor) -> Tensor:
            middle = moved(at, 0.5)
            a = acceleration(middle, at)
            if self.space.groups:
                a = self.space.midpoint_acceleration(dt * at, a, acceleration(middle, torch.zeros_like(at)))
            return at - v - half * a

        middle, found = find_roots(residual, v)
        return Step(moved(middle, 1.0), 2.0 * middle - v, acceleration(q, v), found)


@dataclass(frozen=True, eq=False)
class Projected(Integrator):
    """A RATTLE-like scheme of second order: after every step c(q) = 0 to 1e-12 m and A v = 0 to rounding.

    Velocity Verlet whose position is projected onto c = 0 and whose velocity onto A v = 0, both along M^-1 A^T, as in
    RATTLE (Andersen 1983; Hairer, Lubich & Wanner 2006, VII.1.4). As the accelerations may depend on v, the second one
    is taken at the velocity that Euler's rule predicts. Two evaluations per step. A motion begins at the state nearest
    to the given one that meets the constraint.
    """

    manifold: ConstraintManifold
    space: ConfigurationSpace = VECTORS
    failure = "no position on the surfaces of the contacts near the predicted one"

    @override
    def start(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        return self.manifold.project(q, v)

    @override
    def step(self, acceleration: Acceleration, q: Tensor, v: Tensor, dt: float) -> Step:
        a = acceleration(q, v)
        at = self.manifold.project_position(self.space.integrate(q, dt * v + 0.5 * dt**2 * a))
        # Where it failed, the step is refused anyway: go on from the old position, at which models can be asked.
        reached = torch.where(at.converged[:, None], at.q, q)
        predicted = torch.where(at.converged[:, None], self.manifold.project_velocity(at, v + dt * a), v)
        later = acceleration(reached, predicted)
        halfway = self.space.difference(q, at.q) / dt  # v + dt a / 2 and the impulse of the position's correction
        v_next = self.manifold.project_velocity(at, halfway + 0.5 * dt * later)
        return Step(at.q, v_next, a, at.converged)


def _projected(model: Model) -> Projected:
    switched = dict.fromkeys(contact.switch for contact in model.contacts if contact.switch is not None)
    if switched:
        raise InvalidInput(
            f"integrator 'projected' holds all contacts at all times, and {', '.join(switched)} switch some of them; "
            "use another integrator, or contacts without a switch."
        )
    return Projected(ConstraintManifold(model), model.robot.space)


INTEGRATORS: dict[str, Callable[[Model], Integrator]] = {
    "symplectic-euler": lambda model: SymplecticEuler(model.robot.space),
    "rk4": lambda model: RungeKutta4(model.robot.space),
    "implicit-midpoint": lambda model: ImplicitMidpoint(model.robot.space),
    "projected": _projected,
}
"""Integrators by the name that rollouts and the command line use."""


def integrator_named(name: str, model: Model) -> Integrator:
    """The integrator of that name for motions of `model`. Raises InvalidInput for any other name."""
    require_known("integrator", name, "forcegp", INTEGRATORS, cutoff=0.4)
    return INTEGRATORS[name](model)


def check_time_step(dt: Any) -> None:
    """Raise InvalidInput for what is no positive number."""
    if isinstance(dt, bool) or not (isinstance(dt, int | float) and math.isfinite(dt) and dt > 0):
        raise InvalidInput(f"dt is {dt!r}; give the time step as a positive number of seconds.")


def _all(q: Tensor) -> Tensor:
    device = getattr(q, "device", None)  # expressions of CasADi, which take explicit steps, have none
    return torch.ones(q.shape[0], dtype=torch.bool, device=device)
