"""What to learn where nobody says it: which prior, by a look at a few rows, and what all rows of a log are worth."""

import math
import warnings
from typing import Any

import numpy as np

from forcegp.analytical.least_squares import correlation_time
from forcegp.data import Dataset
from forcegp.errors import DataWarning, ForceGPError
from forcegp.evaluation.prior_comparison import compare_priors
from forcegp.mechanics import KNOWN_FORCES, MechanicalSystem
from forcegp.models import Noise, StructuredPosterior
from forcegp.models.search import MOST_POINTS_FOR_RESTARTS
from forcegp.priors import named_prior

FREE_MOTION = "joint-friction", "joint", "joint + joint-friction"
IN_CONTACT = "tool-friction", "joint", "tool-friction + joint-friction"
"""Priors that are looked at, the one that is taken without a look first."""

FRICTION = tuple(kind for name, kind in KNOWN_FORCES.items() if name.endswith("joint-friction"))

LOOK = 100  # rows
RESIDUALS = 20_000  # rows whose residuals show how long errors resemble each other
NOTICEABLE = 1.5  # rows over which they must for intervals to change


def usual_prior(system: MechanicalSystem) -> str:
    """The prior that is taken without a look: friction of the joints, in contact forces at the tool."""
    return (IN_CONTACT if system.contacts else FREE_MOTION)[0]


def choose_prior(
    dataset: Dataset, system: MechanicalSystem, *, noise: Noise | None = None, seed: int = 0, **how: Any
) -> tuple[str, str]:
    """Name of the prior to learn with, and why, in a sentence.

    In free motion friction of the joints, in contact forces at the tool, unless left-out stretches of `LOOK` rows show
    a force at every joint, or the sum with friction of the joints, to be better (`compare_priors`). `how` are other
    arguments of that. A system with friction laws was identified: what is missing is the rest of the friction, and
    functions of positions and torques only fit what filters leave. Where nothing can be compared (too few rows), the
    first one is taken as well, and the reason says so.
    """
    names = IN_CONTACT if system.contacts else FREE_MOTION
    where = "in contact" if system.contacts else "in free motion"
    if any(isinstance(force, FRICTION) for force in system.known_forces):
        return names[0], f"{names[0]} {where}, beside the friction laws that the system lists"
    priors = {name: named_prior(name, system) for name in names}
    points = min(LOOK, len(dataset))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # the fit gives it
            found = compare_priors(
                dataset, priors, points=points, system=system, noise=noise, restarts=1, seed=seed, **how
            )
    except ForceGPError as error:
        return names[0], f"{names[0]}, the usual one {where}; others could not be compared with it ({error})"
    supported = [score.name for score in found.supported]
    chosen = names[0] if names[0] in supported else found.preferred.name
    others = ", ".join(name for name in names if name != chosen)
    by = f"left-out stretches of {found.block_seconds:.3g} s of {points} rows"
    if chosen == names[0]:
        return chosen, f"{chosen} {where}; {by} do not show {others} to be better"
    scores = {score.name: score for score in found.scores}
    gain = scores[chosen].leave_block_out - scores[names[0]].leave_block_out
    return chosen, f"{chosen} {where}; by {by} it is better than {names[0]}, by {gain:.3g} nats per row"


def all_rows_at_once(count: int) -> dict[str, Any]:
    """Arguments for the `fit` of functions of few inputs to so many rows: exact up to `MOST_POINTS_FOR_RESTARTS`."""
    most = MOST_POINTS_FOR_RESTARTS
    return {} if count <= most else {"engine": "inducing", "learning_points": most}


def allowing_for_correlation(
    posterior: StructuredPosterior, dataset: Dataset
) -> tuple[StructuredPosterior, str | None]:
    """The posterior from all rows of a log, as wide as its independent rows allow; and a note where that matters.

    Errors of filtered and resampled logs resemble each other from row to row; taken for independent, 20,000 rows would
    count as 20,000 facts. With the integrated correlation time k of the residuals, in rows, variances are k times as
    large (`analytical.least_squares.correlation_time`); means stay, for rows that are left out would be missed at
    reversals, where friction changes within a few of them.
    """
    if not dataset.time_ordered:
        return posterior, None
    some = dataset.rows(slice(RESIDUALS))
    residual = posterior.predict(some.q, some.v, some.u, covariance=False).mean.cpu().numpy() - some.a
    spread = residual.std(axis=0)
    times = correlation_time(residual / np.where(spread > 0.0, spread, 1.0), some.episode)
    k = max(1.0, float(np.median(times)))
    if k < NOTICEABLE:
        return posterior, None
    note = f"errors resemble each other over {k:.0f} rows, for which intervals are {math.sqrt(k):.1f} times as wide"
    return posterior.with_settings(widening=math.sqrt(k) * posterior.widening, correlated_rows=k), note
