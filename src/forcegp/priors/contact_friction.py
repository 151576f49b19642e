"""`ContactFriction`: what resists the sliding of a contact, and the normal force that this friction changes itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from forcegp.errors import InvalidInput, require_type, usable_arguments
from forcegp.mechanics import ConstrainedDynamics, MechanicalSystem
from forcegp.priors.expected_friction import ExpectedFriction, TabulatedCurve
from forcegp.priors.force_prior import ExpressedKernels, ForcePrior, Scaling, SumPrior
from forcegp.priors.joint_forces import JointFriction, chosen_inputs, joint_indices
from forcegp.priors.kernels import check_kernel
from forcegp.priors.tool_forces import (
    ToolPoint,
    contact_axes,
    has_contact,
    is_contact_number,
    nominal_normal_force,
    require_contact,
)
from forcegp.robots import Robot

AXES = ("isotropic", "two-axis")
CONTACT_INPUTS = ("velocity", "position")
SMALLEST_SPEED = 1e-6
"""m/s; below it the direction of sliding is rounded off, far below any velocity scale of friction."""


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
        `StructuredGP.fit` finds it for isotropic friction by itself, by fitting again with what it has learned
        (`refined_loads`).
    viscous: the latents are damping coefficients in N/(m/s) (with `load` in s/m): f = g v_t, and g_k v_k along every
        tangent.
    inputs: what the latents depend on, "velocity" (of sliding, see above), "position" (of the contact point along the
        two tangents, which makes a map of the surface), or both.
    kernel: an expression of `forcegp.priors.kernel_of`. None stands for "friction" (Coulomb, Stribeck and viscous
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
    def check(self, system: MechanicalSystem) -> None:
        require_contact("ContactFriction", self.contact, system)
        expected = ExpectedFriction.of(self.expected)
        if expected is not None:
            joint_indices([name for name, _ in expected.joints], system.robot)

    @override
    def latent_names(self, robot: Robot) -> tuple[str, ...]:
        return ("sliding",) if self.axes == "isotropic" else ("tangent-1", "tangent-2")

    @override
    def mixing(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch nv C"]:
        if not has_contact(dynamics, self.contact):
            return torch.zeros_like(dynamics.H[..., :1]).expand(*dynamics.H.shape[:-1], self._count)
        where = ToolPoint.of_contact(dynamics, self.contact)
        return where.jacobian[..., :3, :].mT @ self.point_force(dynamics)

    @override
    def point_force(self, dynamics: ConstrainedDynamics) -> Float[Tensor, "*batch 3 C"]:
        if not has_contact(dynamics, self.contact):
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
        if not has_contact(dynamics, self.contact):  # the force is zero whatever its features are
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


def refined_loads(prior: ForcePrior, robot: Robot, table: Table) -> ForcePrior | None:
    """The same prior, where isotropic `ContactFriction` with a load and no `expected` expects the friction in `table`.

    A first fit takes the normal force under the known forces alone; its posterior mean of the sliding friction, and of
    the `JointFriction` beside it in the sum, gives a better one, with which a second fit finds better curves, and so
    on. An `expected` that is there was given on purpose and stays. None for priors without such a term.
    """
    terms = prior.summands()
    names = prior.latent_names(robot)
    slices = prior.slices(robot) if isinstance(prior, SumPrior) else (slice(0, len(names)),)
    if not any(_wants_load(term) for term in terms):
        return None
    joints = tuple(
        (joint, table(latent))
        for term, which in zip(terms, slices, strict=True)
        if isinstance(term, JointFriction)
        for joint, latent in zip(term.latent_names(robot), names[which], strict=True)
    )
    refined = tuple(
        _expecting(term, ExpectedFriction(table(names[which][0]), joints)) if _wants_load(term) else term
        for term, which in zip(terms, slices, strict=True)
    )
    return refined[0] if len(refined) == 1 else SumPrior(refined)


def _wants_load(term: ForcePrior) -> bool:
    """Whether its latent is a friction coefficient over the sliding speed alone, and the load is still to be found."""
    if not isinstance(term, ContactFriction) or not term.load or term.expected is not None:
        return False
    return term.axes == "isotropic" and term.inputs == ("velocity",) and not term.viscous


def _expecting(term: ForcePrior, expected: ExpectedFriction) -> ContactFriction:
    assert isinstance(term, ContactFriction), "terms with a load are contact frictions"
    return replace(term, expected=expected)
