"""Priors on the forces that nobody modelled."""

from collections.abc import Mapping
from typing import Any

from forcegp.errors import InvalidInput
from forcegp.mechanics.stored_objects import object_from_dict
from forcegp.priors.force_prior import ForcePrior
from forcegp.priors.joint_accelerations import JointAccelerations
from forcegp.priors.joint_forces import JointForces
from forcegp.priors.no_forces import NoForces

PRIORS: dict[str, type[ForcePrior]] = {
    "joint-forces": JointForces,
    "joint-accelerations": JointAccelerations,
    "no-forces": NoForces,
}
"""Priors that stored models can name."""

__all__ = [
    "PRIORS",
    "ForcePrior",
    "JointAccelerations",
    "JointForces",
    "NoForces",
    "prior_from_dict",
    "prior_to_dict",
]


def prior_to_dict(prior: ForcePrior) -> dict[str, Any]:
    """Plain values that `prior_from_dict` turns back. Raises InvalidInput for a prior that is not in `PRIORS`."""
    name = next((name for name, kind in PRIORS.items() if type(prior) is kind), None)
    if name is None:
        raise InvalidInput(
            f"a {type(prior).__name__} cannot be stored: register it first, PRIORS['my-prior'] = "
            f"{type(prior).__name__}; "
            f"registered: {', '.join(PRIORS)}"
        )
    return {"type": name, **prior.to_dict()}


def prior_from_dict(stored: Mapping[str, Any]) -> ForcePrior:
    """The prior that `prior_to_dict` stored. Raises FileFormatError for an unknown type or wrong fields."""
    return object_from_dict("prior", PRIORS, stored)
