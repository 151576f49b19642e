"""The physically possible inertia nearest to one that no body has: a repair on request, with a warning.

Published URDFs break the triangle inequality at times (rounded numbers, unconstrained identification). With the second
moments ``Sigma = tr(I)/2 1 - I`` about the centre of mass a body has the inertia I if and only if Sigma is positive
semi-definite (:mod:`forcegp.robots.inertia`). The nearest one minimises ``|I' - I|_F``. Both matrices have the same
axes and ``|dI|_F^2 = |s|^2 + (s_1 + s_2 + s_3)^2`` for changes s of the eigenvalues of Sigma, so it is a projection in
three variables.
"""

from __future__ import annotations

import warnings
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from forcegp.errors import DataWarning, InvalidInput
from forcegp.robots.inertia import physical_objection
from forcegp.robots.layout import Layout
from forcegp.robots.urdf import RobotDescription, parse_urdf
from forcegp.robots.urdf_file import replace_inertial

InertiaChoice = Literal["strict", "nearest"]
"""What to do about a link with an inertia that no body has: refuse it, or replace it by the nearest possible."""

MARGIN = 1e-3
"""Smallest second moment of a repaired body as a fraction of their sum: 3 % of its size thick, not a plate."""


def nearest_inertia(inertia: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The nearest inertia about the centre of mass (kg m^2) that a body of positive thickness can have.

    Second moments are at least `MARGIN` of the sum of those that were positive.
    """
    moments, axes = np.linalg.eigh(inertia)
    second = 0.5 * moments.sum() - moments
    least = MARGIN * np.maximum(second, 0.0).sum()
    held = second < least  # the others share what is left: all change alike, or are held as well
    while True:
        change = np.where(held, least - second, 0.0)
        change[~held] = -change.sum() / (1.0 + (~held).sum())
        below = (second + change < least) & ~held
        if not below.any():
            break
        held |= below
    second = second + change
    return (axes * (second.sum() - second)) @ axes.T


def with_chosen_inertias(
    choice: str, text: str, description: RobotDescription, layout: Layout
) -> tuple[str, RobotDescription]:
    """URDF text and its description, unless "strict" with possible inertias for impossible ones of moving links.

    Every other byte stays. Warns DataWarning with the link and the relative change. What the inertia alone cannot mend
    (a negative mass) stays, and is refused by :func:`~forcegp.robots.layout.check_inertias`. Raises InvalidInput for
    another choice.
    """
    if choice not in get_args(InertiaChoice):
        raise InvalidInput(f"inertias is {choice!r}; give one of {', '.join(get_args(InertiaChoice))}.")
    if choice == "strict":
        return text, description
    for name in layout.moving:
        inertial = description.links[name]
        objection = inertial and physical_objection(inertial.mass, inertial.center_of_mass, inertial.inertia)
        if inertial is None or objection is None or inertial.mass <= 0.0 or not np.isfinite(inertial.inertia).all():
            continue
        nearest = nearest_inertia(inertial.inertia)
        relative = np.linalg.norm(nearest - inertial.inertia) / np.linalg.norm(inertial.inertia)
        source = description.source
        text = replace_inertial(text, name, inertial.mass, inertial.center_of_mass, nearest, source=source)
        warnings.warn(
            f"{source}: no body has the inertia of link {name!r} ({objection}); the nearest one that a body has "
            f"differs by {100.0 * relative:.2g} % and is used instead.",
            DataWarning,
            stacklevel=4,
        )
    return text, parse_urdf(text, source=description.source)
