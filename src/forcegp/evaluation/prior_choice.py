"""What to learn where nobody says it: which prior, by a look at a few rows, and which of all rows are independent."""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np

from forcegp.analytical.least_squares import correlation_time
from forcegp.data import Dataset
from forcegp.errors import DataWarning, ForceGPError
from forcegp.evaluation.prior_comparison import compare_priors
from forcegp.inference import Inducing
from forcegp.mechanics import (
    CoulombJointFriction,
    DirectionalJointFriction,
    LoadJointFriction,
    MechanicalSystem,
    StribeckJointFriction,
    ViscousJointFriction,
)
from forcegp.models import Noise, StructuredGP, TrainingData
from forcegp.priors import named_prior

FREE_MOTION = "joint-friction", "joint", "joint + joint-friction"
IN_CONTACT = "tool-friction", "joint", "tool-friction + joint-friction"
"""Priors that are looked at, the one that is taken without a look first."""

FRICTION = (
    CoulombJointFriction,
    DirectionalJointFriction,
    LoadJointFriction,
    StribeckJointFriction,
    ViscousJointFriction,
)

LOOK = 100
"""Rows of the look."""
RESIDUALS = 20_000
"""Rows whose residuals show how long errors resemble each other."""
FEWEST = 400
"""Rows that thinning leaves, if there are so many."""


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


def independent_rows(model: StructuredGP, dataset: Dataset, seed: int = 0) -> tuple[Dataset, str | None]:
    """Every k-th row, so that what the model leaves of the acceleration is about independent; and a note if k > 1.

    Errors of filtered and resampled logs resemble each other from row to row; taken for independent, 20,000 rows would
    count as 20,000 facts. k is the integrated correlation time, in rows, of what is left after the forces are learned
    from all of them, at hyper-parameters from `LOOK` rows: what the forces still lack would not be noise.
    """
    if len(dataset) <= FEWEST or not dataset.time_ordered:
        return dataset, None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # the fit gives it
        rough = model.fit(dataset, points=LOOK, restarts=1, seed=seed)
        some = dataset.rows(slice(RESIDUALS))
        given = replace(TrainingData.of(some, rough.training.q.device), reference=rough.training)
        rough = rough.model.condition(given, rough.parameters, rough.result, rough.settings, Inducing())
    residual = rough.predict(some.q, some.v, some.u).mean.cpu().numpy() - some.a
    spread = residual.std(axis=0)
    time = correlation_time(residual / np.where(spread > 0.0, spread, 1.0), some.episode)
    every = max(1, min(round(float(np.median(time))), len(dataset) // FEWEST))
    if every == 1:
        return dataset, None
    kept = dataset.rows(slice(0, None, every))
    note = f"errors resemble each other over {every} rows: every {every}th row was learned from, {len(kept)} in all"
    return replace(kept, system=dataset.system), note
