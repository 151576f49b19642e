"""Which priors files can name, and how a prior becomes plain values and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from forcegp.errors import FileFormatError, InvalidInput
from forcegp.mechanics.stored_objects import object_from_dict
from forcegp.priors.contact_friction import ContactFriction
from forcegp.priors.force_prior import ForcePrior, SumPrior
from forcegp.priors.joint_accelerations import JointAccelerations
from forcegp.priors.joint_forces import JointForces
from forcegp.priors.joint_friction import JointFriction
from forcegp.priors.no_forces import NoForces
from forcegp.priors.payload import Payload
from forcegp.priors.periodic_joint_forces import PeriodicJointForces
from forcegp.priors.tool_forces import ToolForces

PRIORS: dict[str, type[ForcePrior]] = {
    "joint-forces": JointForces,
    "joint-accelerations": JointAccelerations,
    "joint-friction": JointFriction,
    "tool-forces": ToolForces,
    "contact-friction": ContactFriction,
    "periodic-joint-forces": PeriodicJointForces,
    "payload": Payload,
    "no-forces": NoForces,
}
"""Priors that stored models can name, besides sums of them."""

SUM = "sum"


def prior_to_dict(prior: ForcePrior) -> dict[str, Any]:
    """Plain values that `prior_from_dict` turns back. Raises InvalidInput for a prior that is not in `PRIORS`."""
    if isinstance(prior, SumPrior):
        return {"type": SUM, "terms": [prior_to_dict(term) for term in prior.terms]}
    name = next((name for name, kind in PRIORS.items() if type(prior) is kind), None)
    if name is None:
        raise InvalidInput(
            f"a {type(prior).__name__} cannot be stored: register it first, PRIORS['my-prior'] = "
            f"{type(prior).__name__}; registered: {', '.join(PRIORS)}"
        )
    return {"type": name, **prior.to_dict()}


def described_prior(prior: ForcePrior) -> dict[str, Any]:
    """`prior_to_dict`, or the name alone of a prior that is not in `PRIORS`: only storing a model needs more."""
    try:
        return prior_to_dict(prior)
    except InvalidInput:
        return {"type": type(prior).__name__}


def prior_from_dict(stored: object) -> ForcePrior:
    """The prior that `prior_to_dict` stored. Raises FileFormatError for an unknown type or wrong fields."""
    if isinstance(stored, Mapping) and stored.get("type") == SUM:
        terms = stored.get("terms")
        if not isinstance(terms, list | tuple) or set(stored) != {"type", "terms"}:
            raise FileFormatError(f"a stored sum of priors has {sorted(map(str, stored))}; expected a list of terms")
        return SumPrior(tuple(prior_from_dict(term) for term in terms))
    return object_from_dict("prior", PRIORS, stored)
