"""The normal force that friction is proportional to, when friction itself changes it: expected friction as tables."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import isfinite
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils._python_dispatch import _get_current_dispatch_mode

from forcegp.errors import InvalidInput, NumericalWarning
from forcegp.mechanics import ConstrainedDynamics
from forcegp.priors.joint_forces import joint_indices
from forcegp.priors.tool_forces import ToolPoint

SMALLEST_SHARE = 0.1
"""Smallest 1 + mu g: where it nears 0, friction and normal force lift each other without end (jamming)."""
JAMMING = "the expected friction nearly jams"
"""How the warning of it begins."""


@dataclass(frozen=True)
class TabulatedCurve:
    """Values over one velocity, in between and beyond linear: (at, values), `at` increasing.

    Raises InvalidInput for anything but two or more finite places and as many finite values.
    """

    # This constructor is the check, with messages for people; run-time checks of annotations must not come before it.
    __no_type_check__: ClassVar[bool] = True

    at: tuple[float, ...]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("at", "values"):
            object.__setattr__(self, name, _finite(name, getattr(self, name)))
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

    # This constructor is the check, with messages for people; run-time checks of annotations must not come before it.
    __no_type_check__: ClassVar[bool] = True

    sliding: TabulatedCurve
    joints: tuple[tuple[str, TabulatedCurve], ...] = ()

    @classmethod
    def of(cls, given: object) -> ExpectedFriction | None:
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


def _finite(name: str, given: object) -> tuple[float, ...]:
    try:
        values = tuple(float(entry) for entry in given)  # type: ignore[attr-defined]  # errors below
    except (TypeError, ValueError):
        values = (float("nan"),)
    if not all(map(isfinite, values)):
        raise InvalidInput(f"a tabulated curve has {name} {given!r}; give finite numbers")
    return values
