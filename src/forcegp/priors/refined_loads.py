"""Friction that grows with the normal force, and the normal force that changes with friction: one step towards both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from forcegp.priors.contact_friction import ContactFriction
from forcegp.priors.expected_friction import ExpectedFriction, TabulatedCurve
from forcegp.priors.force_prior import ForcePrior, SumPrior
from forcegp.priors.joint_friction import JointFriction
from forcegp.robots import Robot

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
