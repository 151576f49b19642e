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
from forcegp.forces.joint_forces import JointFriction, chosen_inputs, joint_indices
from forcegp.forces.kernels import check_kernel
from forcegp.forces.tool_forces import (
    SMALLEST_SPEED,
    ToolPoint,
    contact_axes,
    finite_numbers,
    is_contact_number,
    nominal_normal_force,
    require_contact,
)
from forcegp.forces.unknown import ExpressedKernels, Scaling, Unknown, UnknownForces
from forcegp.mechanics import ConstrainedDynamics, Contact
from forcegp.robots import Robot

SMALLEST_SHARE = 0.1
"""Smallest 1 + mu g: where it nears 0, friction and normal force lift each other without end (jamming)."""
JAMMING = "the expected friction nearly jams"
"""How the warning of it begins."""


@dataclass(frozen=True)
class TabulatedCurve:
    """Values over one velocity, in between and beyond linear: (at, values), `at` increasing.

    Raises InvalidInput for anything but two or more finite places and as many finite values.
    """

    at: tuple[float, ...]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("at", "values"):
            values = finite_numbers(getattr(self, name))
            if values is None:
                raise InvalidInput(f"a tabulated curve has {name} {getattr(self, name)!r}; give finite numbers")
            object.__setattr__(self, name, values)
        if len(self.at) < 2 or len(self.at) != len(self.values) or any(b <= a for a, b in pairwise(self.at)):
            raise InvalidInput(
                f"a tabulated curve has {len(self.at)} places and {len(self.values)} values; give two or more of each, "
                "places increasing"
            )

    def __call__(self, x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """The value at x; differentiable in x, with steps in the derivative at the places."""
        at, values = (torch.tensor(part, dtype=x.dtype, device=x.device) for part in (self.at, self.values))
        # counted, since torch.searchsorted warns of its copies under vmap
        right = (at < x.detach()[..., None]).sum(-1).clamp(1, len(at) - 1)
        slope = (values[right] - values[right - 1]) / (at[right] - at[right - 1])
        return values[right - 1] + slope * (x - at[right - 1])


@dataclass(frozen=True)
class ExpectedFriction:
    """What is expected of the friction that changes a normal force.

    sliding: friction coefficient over the sliding speed (m/s); joints: joint name -> resisting force (Nm or N) over the
    joint's velocity. Curves may be negative, as those that a fit has found can be where the data are few.
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
        self,
        dynamics: ConstrainedDynamics,
        contact: int,
        direction: Float[Tensor, "*batch 3"],
        speed: Float[Tensor, "*batch"],
    ) -> Float[Tensor, "*batch"]:
        """|normal force| in N under the known forces and the expected friction.

        With the multiplier lambda_0 under known forces and joint friction, and sliding along the unit vector d with the
        coefficient mu, lambda = lambda_0 - mu |s_p lambda| g, where g = (d lambda / d Q_U) J_p^T d, so that
        |lambda| = |lambda_0| / (1 + sign(lambda_0) mu |s_p| g). Where that divisor is below `SMALLEST_SHARE`, it is set
        to it, with a NumericalWarning.
        """
        state, multiplier = dynamics.state, dynamics.multiplier_map()
        robot = state.robot
        rows = multiplier.matrix[..., contact, :]
        free = multiplier.offset[..., contact]
        for index, (_, curve) in zip(joint_indices([name for name, _ in self.joints], robot), self.joints, strict=True):
            free = free - rows[..., index] * curve(state.v[..., index])
        size = torch.linalg.vector_norm(dynamics.normals[..., contact, :], dim=-1)
        J = ToolPoint.of_contact(dynamics, contact).jacobian[..., :3, :]
        g = (rows * (J.mT @ direction[..., None])[..., 0]).sum(-1)
        growth = 1.0 + free.sign() * self.sliding(speed) * size * g
        _warn_of_jamming(growth, contact)
        return size * free.abs() / growth.clamp_min(SMALLEST_SHARE)


def _warn_of_jamming(growth: Tensor, contact: int) -> None:
    """No warning while torch transforms or records the function, where no value may decide anything."""
    if torch._C._are_functorch_transforms_active() or _get_current_dispatch_mode() is not None:
        return
    jammed = growth.detach() < SMALLEST_SHARE
    if bool(jammed.any()):
        warnings.warn(
            f"{JAMMING} contact {contact} in {int(jammed.sum())} of {jammed.numel()} states: "
            "friction and normal force lift each other almost without end, and the normal force is taken as "
            f"{1.0 / SMALLEST_SHARE:g} times that without sliding friction. Check the contact's frame, point and "
            "surface, leave such states out, or give a smaller coefficient, expected=COEFFICIENT (0 for none).",
            NumericalWarning,
            stacklevel=3,
        )


AXES = ("isotropic", "two-axis")
CONTACT_INPUTS = ("velocity", "position")


@dataclass(frozen=True)
class ContactFriction(ExpressedKernels):
    """Q_U = -J_t^T f: tangential friction of contact number `contact`, positive latents resist the motion.

    Isotropic: f = g(|v_t|) v_t / |v_t| with one latent g on the sliding speed. Two-axis: one latent per tangent, each
    on the velocity v_k along its own, f_k = g_k(v_k). Without the velocity among the inputs dry friction along two
    axes is g_k v_k / |v_t|, so that it turns with the motion. Without the contact there is no friction.

    axes: "isotropic" or "two-axis".
    load: the friction is proportional to the nominal normal force (what the contact would carry under the known forces
        alone, `nominal_normal_force`), and the latents are friction coefficients.
    expected: only with `load`, since friction changes the normal force in turn: the friction that the normal force
        counts with, as a coefficient or an `ExpectedFriction`, which stays as it is given. Where it is None,
        `forcegp.fit` finds it for isotropic friction by itself, by fitting again with what it has learned
        (`refined_loads`).
    viscous: the latents are damping coefficients in N/(m/s) (with `load` in s/m): f = g v_t, and g_k v_k along every
        tangent.
    inputs: what the latents depend on, "velocity" (of sliding, see above), "position" (of the contact point along the
        two tangents, which makes a map of the surface), or both.
    kernel: an expression of `forcegp.forces.kernel_of`. None stands for "friction" (dry, varying with speed, viscous
        friction with a learned velocity scale, see `JointFriction`) where the velocity is the only input and the
        friction not viscous, and for "squared-exponential" elsewhere.
    """

    contact: int = 0
    axes: str = "isotropic"
    load: bool = False
    expected: ExpectedFriction | float | None = None
    viscous: bool = False
    inputs: tuple[str, ...] = ("velocity",)
    kernel: str | None = None

    @usable_arguments("ContactFriction")
    def __post_init__(self) -> None:
        require_type("load", self.load, bool)
        if self.axes not in AXES or not is_contact_number(self.contact):
            raise InvalidInput(
                f"ContactFriction has axes {self.axes!r} and contact {self.contact!r}; give 'isotropic' or 'two-axis', "
                "and a contact's number from 0."
            )
        if self.expected is not None and not self.load:
            raise InvalidInput("ContactFriction has an expected friction but no load; give load=True, or leave it out")
        object.__setattr__(self, "expected", ExpectedFriction.of(self.expected))
        object.__setattr__(self, "inputs", chosen_inputs("ContactFriction", self.inputs, CONTACT_INPUTS))
        check_kernel(self.kernel_expression)

    @property
    @override
    def kernel_expression(self) -> str:
        if self.kernel is not None:
            return self.kernel
        return "friction" if self.inputs == ("velocity",) and not self.viscous else "squared-exponential"

    @property
    @override
    def title(self) -> str:
        if self.load:
            return "load-friction"
        return "friction-map" if "position" in self.inputs else "contact-friction"

    @override
    def check(self, robot: Robot, contacts: Sequence[Contact]) -> None:
        if contacts:  # without any, the robot is in the air and this force is zero
            require_contact("ContactFriction", self.contact, contacts)
        expected = ExpectedFriction.of(self.expected)
        if expected is not None:
            joint_indices([name for name, _ in expected.joints], robot)

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return ("sliding",) if self.axes == "isotropic" else ("tangent-1", "tangent-2")

    @override
    def direction(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        if self.contact >= len(dynamics.contacts):
            return torch.zeros_like(dynamics.H[..., :1]).expand(*dynamics.H.shape[:-1], self._count)
        where = ToolPoint.of_contact(dynamics, self.contact)
        return where.jacobian[..., :3, :].mT @ self.point_force(dynamics)

    @override
    def point_force(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch 3 C"]:
        if self.contact >= len(dynamics.contacts):
            return dynamics.H.new_zeros(*dynamics.H.shape[:-2], 3, self._count)
        tangents, sliding = self._sliding(dynamics)
        motion = sliding[..., None] if self.viscous else _direction(sliding)
        if self.axes == "isotropic":
            directions = tangents @ motion
        elif "velocity" in self.inputs and not self.viscous:
            directions = tangents  # the latents are functions of the velocity, sign included
        else:
            directions = tangents * motion.mT
        if self.load:
            directions = self._normal_force(dynamics, tangents, sliding)[..., None, None] * directions
        return -directions

    @override
    def features(self, dynamics: ConstrainedDynamics) -> tuple[Float[Tensor, "*batch _"], ...]:
        if self.contact >= len(dynamics.contacts):  # the force is zero whatever its features are
            width = len(self.inputs) + ("position" in self.inputs)
            return (dynamics.state.q.new_zeros(*dynamics.state.q.shape[:-1], width),) * self._count
        tangents, sliding = self._sliding(dynamics)
        speeds = (_speed(sliding),) if self.axes == "isotropic" else (sliding[..., :1], sliding[..., 1:])
        position = ToolPoint.of_contact(dynamics, self.contact).position
        place = (tangents.mT @ position[..., None])[..., 0]
        return tuple(
            torch.cat([{"velocity": speed, "position": place}[name] for name in self.inputs], dim=-1)
            for speed in speeds
        )

    @override
    def scalings(self, robot: Robot) -> tuple[tuple[Scaling, ...], ...]:
        ways: dict[str, tuple[Scaling, ...]] = {"velocity": ("scale",), "position": ("standardize", "standardize")}
        chosen: tuple[Scaling, ...] = tuple(way for name in self.inputs for way in ways[name])
        return (chosen,) * self._count

    @override
    def feature_names(self, robot: Robot) -> tuple[tuple[str, ...], ...]:
        place = ("tool position along tangent-1 [m]", "tool position along tangent-2 [m]")
        tangents = ("velocity along tangent-1 [m/s]", "velocity along tangent-2 [m/s]")
        moving = ("sliding speed [m/s]",) if self.axes == "isotropic" else tangents
        return tuple(
            tuple(entry for name in self.inputs for entry in {"velocity": (speed,), "position": place}[name])
            for speed in moving
        )

    @override
    def latent_units(self, robot: Robot) -> tuple[str, ...]:
        if self.load:
            unit = "s/m" if self.viscous else ""  # of a friction coefficient per speed, and of a friction coefficient
        else:
            unit = "N/(m/s)" if self.viscous else "N"
        return (unit,) * self._count

    @property
    def _count(self) -> int:
        return 1 if self.axes == "isotropic" else 2

    def _sliding(self, dynamics: ConstrainedDynamics) -> tuple[Tensor, Tensor]:
        """Tangents (..., 3, 2) and the velocity of the contact point along them (..., 2)."""
        where = ToolPoint.of_contact(dynamics, self.contact)
        tangents = contact_axes(dynamics, self.contact)[..., :2]
        return tangents, (tangents.mT @ where.velocity(dynamics.state.v)[..., :3, None])[..., 0]

    def _normal_force(self, dynamics: ConstrainedDynamics, tangents: Tensor, sliding: Tensor) -> Tensor:
        expected = ExpectedFriction.of(self.expected)
        if expected is None:
            return nominal_normal_force(dynamics, self.contact)
        direction = (tangents @ _direction(sliding))[..., 0]
        return expected.normal_force(dynamics, self.contact, direction, _speed(sliding)[..., 0])


def _speed(sliding: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 1"]:
    return (sliding.square().sum(-1, keepdim=True) + SMALLEST_SPEED**2).sqrt()


def _direction(sliding: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2 1"]:
    return (sliding / _speed(sliding))[..., None]


Table = Callable[[str], TabulatedCurve]
"""Name of a latent -> its posterior mean over the velocities that the data visited."""


def refined_loads(forces: UnknownForces, robot: Robot, table: Table) -> UnknownForces | None:
    """The same, where isotropic `ContactFriction` with a load and no `expected` expects the friction in `table`.

    A first fit takes the normal force under the known forces alone; its posterior mean of the sliding friction, and of
    the `JointFriction` beside it in the sum, gives a better one, with which a second fit finds better curves, and so
    on. An `expected` that is there was given on purpose and stays. None for forces without such a term.
    """
    names = forces.latent_names(robot)
    if not any(_wants_load(term) for term in forces.terms):
        return None
    joints = tuple(
        (joint, table(latent))
        for _, term, which in forces.named(robot)
        if isinstance(term, JointFriction)
        for joint, latent in zip(term.latent_names(robot), names[which], strict=True)
    )
    return UnknownForces(
        tuple(
            replace(term, expected=ExpectedFriction(table(names[which][0]), joints))
            if isinstance(term, ContactFriction) and _wants_load(term)
            else term
            for _, term, which in forces.named(robot)
        )
    )


def _wants_load(term: Unknown) -> bool:
    """Whether its latent is a friction coefficient over the sliding speed alone, and the load is still to be found."""
    if not isinstance(term, ContactFriction) or not term.load or term.expected is not None:
        return False
    return term.axes == "isotropic" and term.inputs == ("velocity",) and not term.viscous


def foot_friction(contacts: tuple[int, ...] = (0, 1, 2, 3)) -> tuple[ContactFriction, ...]:
    """Friction under feet that slide: a `ContactFriction` in proportion to the normal force at each of the contacts.

    The contacts are surfaces on which feet slide, such as `Contact(foot, point, Plane(...), switch=...)`; in rows whose
    switch is 0 there is neither normal force nor friction. Points that are held (`fixed_point`) do not slide.
    """
    return tuple(ContactFriction(contact=contact, load=True) for contact in contacts)
