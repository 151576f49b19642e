"""Warnings about a payload that was found: its interval holds the random part of the error only."""

from warnings import warn

import numpy as np
from jaxtyping import Bool, Float

from forcegp.errors import DataWarning
from forcegp.evidence.least_squares import Fit
from forcegp.evidence.payload_link import CLEARLY, left_by_least_squares

ALIKE = 5.0  # times the error of a mass without offsets
RIGHT = 0.01  # residuals over a payload's torques below which it is right as it is
LEAST = 0.05  # share of the squares that a payload leaves, which only numbers of no body explain


def warn_of_offsets(fit: Fit, offsets: Bool[np.ndarray, " terms"], slope: Float[np.ndarray, " 10"], own: slice) -> None:
    """Where constant torques of joints look like the weight, since postures differ little; `slope` is that of the mass.

    Small errors of a model are then large ones of the mass, of which intervals hold the random part only. `own` are the
    coordinates of the payload, and the last ones those of `offsets`.
    """
    whole, seen = fit.information + fit.prior_information, np.zeros(len(fit.x))
    seen[own] = slope
    held = np.append(np.ones(len(seen) - len(offsets), dtype=bool), ~offsets)
    known = whole[np.ix_(held, held)]
    with_offsets, without = seen @ np.linalg.solve(whole, seen), seen[held] @ np.linalg.solve(known, seen[held])
    if with_offsets > ALIKE**2 * without:
        warn(
            "constant torques of the joints ('offset') look like the payload's weight in these postures: with them its "
            f"mass is {(with_offsets / without) ** 0.5:.0f} times as unsure, and small errors of the model change it. "
            "Leave 'offset' out, or give a baseline, or a log of more postures.",
            DataWarning,
            stacklevel=5,
        )


def warn_of_no_body(
    fit: Fit, parameters: Float[np.ndarray, "10"], slopes: Float[np.ndarray, "10 10"], own: slice, link: str
) -> None:
    """Where ten free numbers in place of the payload's `parameters` explain much more: no body there does.

    Inside of what bodies can have, the best numbers are those found, and free ones explain no more. `own` are the
    coordinates of the payload, `slopes` derivatives of its parameters in them.
    """
    payload = fit.jacobian[..., own] @ np.linalg.inv(slopes)
    white, others = fit.residual / fit.noise, np.delete(fit.jacobian, np.r_[own], axis=-1)
    left, _ = left_by_least_squares(np.concatenate([payload, others], axis=-1) / fit.noise[:, None], white)
    cost = 0.5 * float((white**2).sum())
    more = cost - 0.5 * float((left**2).sum())
    rough = np.linalg.norm(fit.residual) > RIGHT * np.linalg.norm(payload @ parameters)
    if rough and more > max(CLEARLY, LEAST * cost):
        warn(
            f"no body on {link} explains the log: free numbers in place of its mass, centre and inertia leave "
            f"{more / cost:.0%} less. The payload is on another link, or links weigh less or otherwise than the URDF "
            "states. Give link, or a baseline (a log without the payload), or identify all links.",
            DataWarning,
            stacklevel=5,
        )
