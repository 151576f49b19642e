"""`ContactFriction`: what resists the sliding of a contact, and the normal force that this friction changes itself."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils._python_dispatch import _get_current_dispatch_mode
from typing_extensions import override

from forcegp.errors import InvalidInput, NumericalWarning, require_type, usable_arguments
from forcegp.forces.joint_forces import JointFriction, joint_indices
from forcegp.forces.kernels import checked_kernel
from forcegp.forces.link_forces import SMALLEST_SPEED, ToolPoint, contact_axes, require_contact, require_contact_number
from forcegp.forces.unknown import ExpressedKernels, Scaling, UnknownForces
from forcegp.mechanics import ConstrainedDynamics, Contact
from forcegp.robots import Robot
from forcegp.robots.arguments import finite_vector, is_sequence

SMALLEST_SHARE = 0.1
"""Smallest 1 + mu g: where it nears 0, friction and normal force lift each other without end (jamming)."""
JAMMING = "the expected friction nearly jams"  # how the warning of it begins
Numbers = Float[Tensor, "*batch"]


@dataclass(frozen=True)
class TabulatedCurve:
    """Values over one velocity, in between and beyond linear: (at, values), `at` increasing.

    Raises InvalidInput for anything but two or more finite places and as many finite values.
    """

    at: tuple[float, ...]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("at", "values"):
            given = getattr(self, name)
            values = tuple(given) if is_sequence(given) else ()
            found = finite_vector(f"{name} of a tabulated curve", values, len(values))
            object.__setattr__(self, name, tuple(found.tolist()))
        if len(self.at) < 2 or len(self.at) != len(self.values) or any(b <= a for a, b in pairwise(self.at)):
            seen = f"a tabulated curve has {len(self.at)} places and {len(self.values)} values"
            raise InvalidInput(f"{seen}; give two or more of each, places increasing")

    def __call__(self, x: Numbers) -> Numbers:
        """The value at x; differentiable in x, with steps in the derivative at the places."""
        at, values = (torch.tensor(part, dtype=x.dtype, device=x.device) for part in (self.at, self.values))
        # counted, since torch.searchsorted warns of its copies under vmap
        right = (at < x.detach()[..., None]).sum(-1).clamp(1, len(at) - 1)
        slope = (values[right] - values[right - 1]) / (at[right] - at[right - 1])
        return values[right - 1] + slope * (x - at[right - 1])


@dataclass(frozen=True)
class ExpectedFriction:
    """What is expected of the friction that changes a normal force.

    sliding: coefficient over the sliding speed (m/s); joints: name -> resisting force (Nm or N) over the velocity.
    """

    sliding: TabulatedCurve
    joints: tuple[tuple[str, TabulatedCurve], ...] = ()

    @classmethod
    def of(cls, given: object) -> "ExpectedFriction | None":
        """None, a coefficient that holds at all speeds, an `ExpectedFriction`, or what files hold of one.

        Raises InvalidInput for anything else, and for a coefficient that is negative or not finite.
        """
        if given is None or isinstance(given, ExpectedFriction):
            return given
        message = f"expected is {given!r}; give a friction coefficient of at least 0, an ExpectedFriction, or None"
        try:
            if isinstance(given, Mapping):
                joints = tuple((str(name), TabulatedCurve(**curve)) for name, curve in given["joints"])
                return cls(TabulatedCurve(**given["sliding"]), joints)
            coefficient = float(given)  # type: ignore[arg-type]  # what is no number is an error below
        except (TypeError, ValueError, KeyError):
            raise InvalidInput(message) from None
        if not 0.0 <= coefficient < float("inf"):
            raise InvalidInput(message)
        return cls(TabulatedCurve((0.0, 1.0), (coefficient, coefficient)))

    def normal_force(
        self, dynamics: ConstrainedDynamics, contact: int, direction: Float[Tensor, "*batch 3"], speed: Numbers
    ) -> Numbers:
        """|normal force| in N under the known forces and the expected friction.

        |lambda| = |lambda_0| / (1 + sign(lambda_0) mu |s_p| g), g = (d lambda / d Q_U) J_p^T d, for sliding along d
        with the coefficient mu. A divisor below `SMALLEST_SHARE` is set to it, with a NumericalWarning.
        """
        state, multiplier = dynamics.state, dynamics.multiplier_map()
        robot, rows, free = state.robot, multiplier.matrix[..., contact, :], multiplier.offset[..., contact]
        for index, (_, curve) in zip(joint_indices([name for name, _ in self.joints], robot), self.joints, strict=True):
            free = free - rows[..., index] * curve(state.v[..., index])
        size = torch.linalg.vector_norm(dynamics.normals[..., contact, :], dim=-1)
        J = ToolPoint.of_contact(dynamics, contact).jacobian[..., :3, :]
        g = (rows * (J.mT @ direction[..., None])[..., 0]).sum(-1)
        growth = 1.0 + free.sign() * self.sliding(speed) * size * g
        jammed = growth.detach() < SMALLEST_SHARE
        # no value may decide anything while torch transforms or records the function
        traced = torch._C._are_functorch_transforms_active() or _get_current_dispatch_mode() is not None
        if not traced and bool(jammed.any()):
            seen = f"{JAMMING} contact {contact} in {int(jammed.sum())} of {jammed.numel()} states"
            why = "friction and normal force lift each other almost without end"
            taken = f"the normal force is taken as {1.0 / SMALLEST_SHARE:g} times that without sliding friction"
            advice = "leave such states out, or give a smaller coefficient, expected=COEFFICIENT (0 for none)."
            text = f"{seen}: {why}, and {taken}. Check the contact's frame, point and surface, {advice}"
            warnings.warn(text, NumericalWarning, stacklevel=2)
        return size * free.abs() / growth.clamp_min(SMALLEST_SHARE)


def nominal_normal_force(dynamics: ConstrainedDynamics, contact: int) -> Numbers:
    """|normal force| in N that the contact would have if the known forces were all: |s_p| |lambda(Q_U = 0)|."""
    size = torch.linalg.vector_norm(dynamics.normals[..., contact, :], dim=-1)
    return size * dynamics.multiplier_map().offset[..., contact].abs()


@dataclass(frozen=True)
class ContactFriction(ExpressedKernels):
    """Q_U = -J_t^T g(|v_t|) v_t / |v_t|: what resists the sliding of contact number `contact`; none without it.

    load: the friction is proportional to the nominal normal force (`nominal_normal_force`), the latent a coefficient.
    expected: only with `load`, the friction that the normal force counts with, as a coefficient or an
        `ExpectedFriction`. None: `forcegp.fit` finds it, by fitting again with what it has learned (`refined_loads`).
    kernel: an expression of `forcegp.forces.kernel_of`.
    """

    contact: int = 0
    load: bool = False
    expected: ExpectedFriction | float | None = None
    kernel: str = "friction"

    @usable_arguments("ContactFriction")
    def __post_init__(self) -> None:
        require_type("load", self.load, bool)
        require_contact_number("ContactFriction", self.contact)
        if self.expected is not None and not self.load:
            raise InvalidInput("ContactFriction has an expected friction but no load; give load=True, or leave it out")
        object.__setattr__(self, "expected", ExpectedFriction.of(self.expected))
        checked_kernel(self.kernel)

    @property
    @override
    def title(self) -> str:
        return "load-friction" if self.load else "contact-friction"

    @override
    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        if contacts:  # without any, the robot is in the air and this force is zero
            require_contact("ContactFriction", self.contact, contacts)
        if isinstance(self.expected, ExpectedFriction):
            joint_indices([name for name, _ in self.expected.joints], robot)

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return ("sliding",)

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        if self.contact >= len(dynamics.contacts):
            return torch.zeros_like(dynamics.H[..., :1])
        return ToolPoint.of_contact(dynamics, self.contact).jacobian[..., :3, :].mT @ self.point_force(dynamics)

    @override
    def point_force(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch 3 C"]:
        if self.contact >= len(dynamics.contacts):
            return dynamics.H.new_zeros(*dynamics.H.shape[:-2], 3, 1)
        tangents, sliding, speed = self._sliding(dynamics)
        direction = tangents @ (sliding / speed)[..., None]
        if not self.load:
            return -direction
        if isinstance(self.expected, ExpectedFriction):
            normal_force = self.expected.normal_force(dynamics, self.contact, direction[..., 0], speed[..., 0])
        else:
            normal_force = nominal_normal_force(dynamics, self.contact)
        return -(normal_force[..., None, None] * direction)

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        if self.contact >= len(dynamics.contacts):  # the force is zero whatever its features are
            return (dynamics.state.q.new_zeros(*dynamics.state.q.shape[:-1], 1),)
        return (self._sliding(dynamics)[2],)

    @override
    def scalings(self, robot: Robot) -> tuple[Scaling, ...]:
        return ("scale",)

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        return (("sliding speed [m/s]",),)

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        return ("" if self.load else "N",)

    def _sliding(self, dynamics: ConstrainedDynamics) -> tuple[Tensor, Tensor, Tensor]:
        """Tangents (..., 3, 2), the velocity of the contact point along them (..., 2), and its size (..., 1)."""
        where, tangents = ToolPoint.of_contact(dynamics, self.contact), contact_axes(dynamics, self.contact)[..., :2]
        sliding = (tangents.mT @ where.velocity(dynamics.state.v)[..., :3, None])[..., 0]
        return tangents, sliding, (sliding.square().sum(-1, keepdim=True) + SMALLEST_SPEED**2).sqrt()


Table = Callable[[str], TabulatedCurve]
"""Name of a latent -> its posterior mean over the velocities that the data visited."""


def refined_loads(forces: UnknownForces, robot: Robot, table: Table) -> UnknownForces | None:
    """The same, where `ContactFriction` with a load and no `expected` expects the friction in `table`.

    That of the sliding, and of the `JointFriction` beside it. None for forces without such a term.
    """
    names, terms = forces.latent_names(robot), list(forces.terms)
    loaded = {k: term for k, term in enumerate(terms) if isinstance(term, ContactFriction) and term.load}
    if not (wanting := {k: term for k, term in loaded.items() if term.expected is None}):
        return None
    latents, joints = [names[which] for which in forces.slices(robot)], list[tuple[str, TabulatedCurve]]()
    for term, own in zip(terms, latents, strict=True):
        if isinstance(term, JointFriction):
            joints += zip(term.latent_names(robot), map(table, own), strict=True)
    for k, term in wanting.items():
        terms[k] = replace(term, expected=ExpectedFriction(table(latents[k][0]), tuple(joints)))
    return UnknownForces(tuple(terms))
