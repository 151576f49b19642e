"""States, contacts, and Gauss' principle: what a constrained rigid body does under given forces.

    M a = Q + Q_I,  A a = b   gives   a = M^-1 Q_b + H Q,   lambda = (A M^-1 A^T)^+ (b - A M^-1 Q),   Q_I = A^T lambda
    H = M^-1 - M^-1 A^T (A M^-1 A^T)^+ A M^-1,   Q_b = A^T (A M^-1 A^T)^+ b

(Udwadia & Kalaba 1992; Rath et al. 2021, eqs. 2-4), from the pseudo-inverse of A~ = A L^-T with M = L L^T, redundant
constraints included: (A M^-1 A^T)^+ = (A~^+)^T A~^+, H = L^-T (I - A~^+ A~) L^-1.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from forcegp.errors import ContactError, InvalidInput, NumericalError, require_number
from forcegp.mechanics.surfaces import Held, Surface, surface_from_dict, surface_to_dict
from forcegp.robots import Kinematics, Robot
from forcegp.robots.arguments import finite_vector


@dataclass(frozen=True)
class Baumgarte:
    """Stabilisation of c(q) = 0: c'' = -2 zeta omega c' - omega^2 c (Baumgarte 1972), omega in rad/s."""

    omega: float
    zeta: float = 1.0

    def __post_init__(self) -> None:
        for name in ("omega", "zeta"):
            words = "it must be a finite number >= 0 (and < 1e15)"  # its square must not overflow
            require_number(f"Baumgarte {name}", getattr(self, name), words, 0.0, 1e15)


def placed(
    kinematics: Kinematics, frame: str, point: Sequence[float]
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """In the world: the axes of a link frame, and the position of a point [m] fixed in it."""
    pose = kinematics.frame_pose(frame)
    axes, local = pose[..., :3, :3], torch.tensor(point, dtype=pose.dtype, device=pose.device)
    return axes, axes @ local + pose[..., :3, 3]


OPEN = 0.5
"""Of a switch, where a log leaves open whether the contact holds: it may bear a force, and its motion is not known."""


@dataclass(frozen=True)
class Contact:
    """A point of the robot stays on a surface: one bilateral constraint s(p(q)) = 0.

    `point` is in m in the link frame `frame`. With a `switch` it acts in rows whose input of that name is 1, not 0.
    With a `radius` [m] the point is the centre of a ball that rolls on level ground, of which `Held` holds the lowest.
    """

    frame: str
    point: tuple[float, float, float]
    surface: Surface
    switch: str | None = None
    radius: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.frame, str):
            raise InvalidInput(f"Contact frame is {self.frame!r}; give the name of a link.")
        if not isinstance(self.surface, Surface):
            seen = f"Contact surface is a {type(self.surface).__name__}"
            raise InvalidInput(f"{seen}; give a Plane, Sphere, ImplicitSurface ...")
        if self.switch is not None and not (isinstance(self.switch, str) and self.switch):
            raise InvalidInput(f"Contact switch is {self.switch!r}; give the name of an input, or None.")
        point = finite_vector("Contact point", self.point, 3, f" x, y, z in m, in frame {self.frame!r}")
        object.__setattr__(self, "point", tuple(point.tolist()))
        require_number("Contact radius", self.radius, "give that of a ball in m, 0 for a point", 0.0, 1e3)
        if self.radius and not isinstance(self.surface, Held):
            raise InvalidInput("Contact radius is of a ball that rolls on level ground; its surface must be a Held.")

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and names. Raises ContactError for a surface that holds code."""
        return vars(self) | {"point": list(self.point), "surface": surface_to_dict(self.surface)}

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> "Contact":
        """What `to_dict` gave. Raises FileFormatError, InvalidInput, KeyError or TypeError for anything else."""
        given: dict[str, Any] = {**stored, "surface": surface_from_dict(stored["surface"])}
        return cls(**given)

    def check(self, robot: Robot) -> None:
        """Raise UnknownName for a frame that is not there, ContactError where the contact constrains nothing."""
        if robot.frame(self.frame)[0] < 0:
            seen = f"frame {self.frame!r} of {robot.name} is fixed in the world, so a contact there constrains nothing"
            raise ContactError(f"{seen}; name a frame that moves.")

    def position(self, kinematics: Kinematics) -> Float[Tensor, "*batch 3"]:
        """World position p(q) of the contact point (..., 3) in m."""
        return placed(kinematics, self.frame, self.point)[1]

    def distance(self, kinematics: Kinematics) -> Float[Tensor, "*batch"]:
        """c(q) = s(p(q)): 0 where the constraint holds."""
        return self.surface.value(self.position(kinematics))

    def off(self, kinematics: Kinematics) -> Float[Tensor, "*batch"]:
        """How far the point is off the surface [m], with a sign, to first order: c / |s_p|."""
        p = self.position(kinematics)
        return self.surface.value(p) / torch.linalg.vector_norm(self.surface.gradient(p), dim=-1)

    def _touching(self, twist: Float[Tensor, "*batch 6 k"]) -> Float[Tensor, "*batch 3 k"]:
        """v + w x r of what touches the ground, r = -`radius` z (Featherstone 2008, section 3.5)."""
        linear, angular = twist[..., :3, :], twist[..., 3:, :]
        if not self.radius:
            return linear
        x, y, z = angular.unbind(-2)
        return linear + self.radius * torch.stack([-y, x, torch.zeros_like(z)], dim=-2)

    def constraint(
        self, state: "State", baumgarte: Baumgarte | None
    ) -> tuple[Float[Tensor, "*batch nv"], Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
        """One row of A (..., nv), one entry of b (...), and the surface gradient s_p (..., 3), with A a = b.

        A = s_p J_p, A' v = s_p Jdot_p v + (J_p v)^T s_pp (J_p v), b = -A' v - 2 zeta omega A v - omega^2 c (Rath 2021).
        """
        p, v = self.position(state.kinematics), state.v
        J, gradient = self._touching(state.kinematics.frame_jacobian(self.frame, self.point)), self.surface.gradient(p)
        A = (gradient[..., None, :] @ J)[..., 0, :]
        bias, velocity = state.kinematics.frame_bias_acceleration(self.frame, self.point), (J @ v[..., None])[..., 0]
        curvature = (velocity[..., None, :] @ self.surface.hessian(p) @ velocity[..., None])[..., 0, 0]
        b = -(gradient * self._touching(bias[..., None])[..., 0]).sum(-1) - curvature
        if baumgarte is not None:
            c = self.surface.value(p)
            b = b - 2.0 * baumgarte.zeta * baumgarte.omega * (A * v).sum(-1) - baumgarte.omega**2 * c
        if self.switch is None:
            return A, b, gradient
        acts = self.acts(state.u, state.inputs).to(b.dtype)
        return acts[..., None] * A, acts * b, gradient  # a row of zeros has no multiplier and constrains nothing

    def acts(self, u: Float[Tensor, "*batch nu"], inputs: Sequence[str]) -> Bool[Tensor, "*#batch"]:
        """Where it holds: where its switch is beyond `OPEN`, or everywhere."""
        always = torch.ones(1, dtype=torch.bool, device=u.device)
        return always if self.switch is None else u[..., inputs.index(self.switch)] > OPEN


AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def fixed_point(
    frame: str, point: tuple[float, float, float] = (0.0, 0.0, 0.0), switch: str | None = None, radius: float = 0.0
) -> tuple[Contact, Contact, Contact]:
    """A point of the robot that does not move, such as a foot: its multipliers are the force on it in N, world axes.

    With a `radius` [m] it is the centre of a ball that rolls on level ground without slipping.
    """
    return tuple(Contact(frame, point, Held(axis), switch, radius=radius) for axis in AXES)  # type: ignore[return-value]  # three


def fixed_frame(frame: str, switch: str | None = None, size: float = 0.1) -> tuple[Contact, ...]:
    """A link that neither moves nor turns, such as a flat foot: its origin and points `size` m along x and y are held.

    Of these nine constraints six are independent, which is legal: the multipliers are the smallest that hold it.
    """
    points = ((0.0, 0.0, 0.0), (size, 0.0, 0.0), (0.0, size, 0.0))
    return tuple(contact for point in points for contact in fixed_point(frame, point, switch))


@dataclass(frozen=True, eq=False)
class State:
    """Positions, velocities and inputs of equal batch.

    `inputs` names the columns of u, `delivered` are the joint forces (..., nv) of its actuators, `strokes` the
    displacements of each joint (or motor, for laws at motors) between reversals before the state, the last first.
    """

    q: Float[Tensor, "*batch nq"]
    v: Float[Tensor, "*batch nv"]
    u: Float[Tensor, "*batch nu"]
    robot: Robot
    inputs: tuple[str, ...] = ()
    delivered_by: "Callable[[State], Tensor] | None" = None
    strokes: Float[Tensor, "*batch nv strokes"] | None = None

    @cached_property
    def kinematics(self) -> Kinematics:
        """Of all bodies; most laws of joints do not need it."""
        return Kinematics.of(self.robot, self.q, self.v)

    @cached_property
    def positions(self) -> Float[Tensor, "*batch nv"]:
        """Positions of the joints; 0 in the places of joints of several degrees of freedom."""
        if self.robot.space.is_vector_space:
            return self.q
        out = torch.zeros_like(self.v)
        out[..., self.robot.space.single_rows] = self.robot.space.singles(self.q)
        return out

    @cached_property
    def mass_matrix(self) -> Float[Tensor, "*batch nv nv"]:
        """M of the robot, with its armature."""
        return self.kinematics.mass_matrix()

    @cached_property
    def bias(self) -> Float[Tensor, "*batch nv"]:
        """Coriolis, centrifugal and gravity forces."""
        return self.kinematics.bias_forces()

    @property
    def delivered(self) -> Float[Tensor, "*batch nv"]:
        """Joint forces of the actuators, thrusters included, in Nm or N."""
        return self.u if self.delivered_by is None else self.delivered_by(self)


REDUNDANCY_TOLERANCE = 1e-9  # singular values of A~ below this fraction of the largest belong to redundant constraints


class AffineMap(NamedTuple):
    """y = offset + matrix @ Q for joint forces Q (..., nv)."""

    offset: Tensor  # (..., k)
    matrix: Tensor  # (..., k, nv)

    def __call__(self, Q: Float[Tensor, "*batch nv"]) -> Tensor:
        """The value y at joint forces Q."""
        return self.offset + (self.matrix @ Q[..., None])[..., 0]


@dataclass(frozen=True, eq=False)
class ConstrainedDynamics:
    """The dynamics at a batch of states, affine in the joint forces that are still unknown.

    `A` (..., m, nv), `b` (..., m), `M`, `H` (..., nv, nv), `Q_K` (..., nv); `normals` (..., m, 3) are gradients s_p, so
    that the contact force on the robot in N is s_p^T lambda. `contacts` are what the rows of A belong to.
    """

    state: State
    M: Float[Tensor, "*batch nv nv"]
    A: Float[Tensor, "*batch m nv"]
    b: Float[Tensor, "*batch m"]
    normals: Float[Tensor, "*batch m 3"]
    Q_K: Float[Tensor, "*batch nv"]
    contacts: tuple[Contact, ...] = ()
    H: Float[Tensor, "*batch nv nv"] = field(init=False)
    constrained_offset: Float[Tensor, "*batch nv"] = field(init=False)  # M^-1 Q_b
    inverse_lower: Float[Tensor, "*batch nv nv"] = field(init=False)  # L^-1
    pseudo_inverse: Float[Tensor, "*batch nv m"] = field(init=False)  # A~^+

    def __post_init__(self) -> None:
        """Gauss' principle for M and A a = b. NumericalError where M is not positive definite or A not finite."""
        identity = torch.eye(self.M.shape[-1], dtype=self.M.dtype, device=self.M.device)
        try:
            lower = torch.linalg.cholesky(self.M)
        except torch.linalg.LinAlgError:
            seen = "the mass matrix is not positive definite"
            raise NumericalError(f"{seen}; check the inertias, masses and armature of the robot") from None
        inverse_lower = torch.linalg.solve_triangular(lower, identity.expand_as(self.M), upper=False)
        A_white = self.A @ inverse_lower.mT
        if self.A.shape[-2]:
            try:
                pseudo_inverse = torch.linalg.pinv(A_white, rtol=REDUNDANCY_TOLERANCE)
            except torch.linalg.LinAlgError:
                seen = "the constraint matrix A is not finite"
                raise NumericalError(f"{seen}; Model.check_states names the row and the contact") from None
        else:
            pseudo_inverse = A_white.mT
        H = inverse_lower.mT @ (identity - pseudo_inverse @ A_white) @ inverse_lower
        H, offset = 0.5 * (H + H.mT), (inverse_lower.mT @ (pseudo_inverse @ self.b[..., None]))[..., 0]
        made = {"H": H, "constrained_offset": offset, "inverse_lower": inverse_lower, "pseudo_inverse": pseudo_inverse}
        vars(self).update(made)  # of a frozen value

    def off(self) -> Float[Tensor, "*batch m"]:
        """How far the points of the contacts are off their surfaces, in m."""
        state = self.state  # 0 where a switch lets it go
        found = [each.acts(state.u, state.inputs) * each.off(state.kinematics) for each in self.contacts]
        return torch.stack(found, dim=-1) if found else self.b

    def acceleration_map(self) -> AffineMap:
        """a = offset + H Q_U with offset = M^-1 Q_b + H Q_K."""
        return AffineMap(self.constrained_offset + (self.H @ self.Q_K[..., None])[..., 0], self.H)

    def multiplier_map(self) -> AffineMap:
        """lambda = offset + matrix Q_U, in N for surfaces that are signed distances."""
        projector = self.pseudo_inverse @ (self.A @ self.inverse_lower.mT)  # A~^+ A~
        matrix = -self.pseudo_inverse.mT @ projector @ self.inverse_lower
        offset = (self.pseudo_inverse.mT @ (self.pseudo_inverse @ self.b[..., None]))[..., 0]
        return AffineMap(offset + (matrix @ self.Q_K[..., None])[..., 0], matrix)

    def contact_force_map(self) -> AffineMap:
        """World force on the robot at each contact in turn, s_p^T lambda, stacked to (..., 3 m), in N."""
        multiplier = self.multiplier_map()
        offset = (self.normals * multiplier.offset[..., None]).flatten(-2)
        return AffineMap(offset, (self.normals[..., None] * multiplier.matrix[..., None, :]).flatten(-3, -2))

    def force_at(self, frame: str) -> AffineMap:
        """World force on the robot (..., 3) at the contacts of a frame together, in N.

        Of a surface it is the part along the normal, (..., 1): friction along it is another force. Or ContactError.
        """
        if not (places := [k for k, contact in enumerate(self.contacts) if contact.frame == frame]):
            raise ContactError(f"the model has no contact at {frame!r}, where a force was measured; give it one.")
        multiplier, normals = self.multiplier_map(), self.normals[..., places, :].mT
        if any(not isinstance(self.contacts[k].surface, Held) for k in places):
            normals = torch.linalg.vector_norm(normals, dim=-2, keepdim=True)
        offset = (normals @ multiplier.offset[..., places, None])[..., 0]
        return AffineMap(offset, normals @ multiplier.matrix[..., places, :])

    def as_measured(self, frame: str, force: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch k"]:
        """Of a measured force what `force_at` predicts."""
        places = [k for k, contact in enumerate(self.contacts) if contact.frame == frame]
        if all(isinstance(self.contacts[k].surface, Held) for k in places):
            return force
        normals = self.normals[..., places, :].sum(-2)
        return (normals * force).sum(-1, keepdim=True) / torch.linalg.vector_norm(normals, dim=-1, keepdim=True)

    def acceleration(self, Q_U: Float[Tensor, "*#batch nv"]) -> Float[Tensor, "*batch nv"]:
        """a = M^-1 Q_b + H (Q_K + Q_U) in rad/s^2 or m/s^2."""
        return self.acceleration_map()(Q_U)

    def acceleration_under(self, Q: Float[Tensor, "*#batch nv"]) -> Float[Tensor, "*batch nv"]:
        """a = M^-1 Q_b + H Q for all joint forces Q, without H: a few products of a matrix and a vector."""
        white = self.inverse_lower @ Q[..., None]
        change = self.pseudo_inverse @ (self.b[..., None] - self.A @ self.inverse_lower.mT @ white)
        return (self.inverse_lower.mT @ (white + change))[..., 0]

    def multiplier(self, Q_U: Float[Tensor, "*#batch nv"]) -> Float[Tensor, "*batch m"]:
        """lambda = (A M^-1 A^T)^+ (b - A M^-1 (Q_K + Q_U)); the constraint force is A^T lambda."""
        return self.multiplier_map()(Q_U)
