"""What to learn where nobody says it: which prior, by a look at a few rows, and what all rows of a log are worth."""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from forcegp.analytical.least_squares import correlation_time
from forcegp.analytical.recorded_rows import slides
from forcegp.data import Dataset, thruster_columns
from forcegp.errors import DataWarning, ForceGPError
from forcegp.evaluation.prior_comparison import compare_priors
from forcegp.inference import Inducing
from forcegp.mechanics import KNOWN_FORCES, MechanicalSystem
from forcegp.models import Noise, StructuredGP, StructuredPosterior
from forcegp.models.search import MOST_POINTS_FOR_RESTARTS
from forcegp.models.structured.refinement import refined
from forcegp.priors import named_prior

FREE_MOTION = "joint-friction", "joint", "joint + joint-friction"
IN_CONTACT = "tool-friction", "joint", "tool-friction + joint-friction"
FLYING = "aerodynamic", "base-wrench"
FREE_BODY = "joint", "base-wrench"
FLYING_ARM = "joint-friction + aerodynamic", "joint-friction", "aerodynamic"
"""Priors that are looked at, the one that is taken without a look first."""

FRICTION = tuple(kind for name, kind in KNOWN_FORCES.items() if name.endswith("joint-friction"))

LOOK = 100  # rows
RESIDUALS = 20_000  # rows whose residuals show how long errors resemble each other
NOTICEABLE = 1.5  # rows over which they must to count for less
RESIDUALS_OF_FORCES = 1000  # rows that show where the noise of forces begins


def usual_prior(system: MechanicalSystem) -> str:
    """The prior that is taken without a look: friction of the joints, in contact forces at the tool, in flight air."""
    return _looked_at(system)[0][0]


def _looked_at(system: MechanicalSystem) -> tuple[tuple[str, ...], str]:
    """Names of priors, and where the robot moves. Under feet that stand nothing slides, so no friction acts there."""
    if thruster_columns(system):
        return FLYING_ARM if system.robot.single_joint_names else FLYING, "in flight"
    if any(slides(contact) for contact in system.touching):
        return IN_CONTACT, "in contact"
    if not system.robot.single_joint_names:
        return FREE_BODY, "of a body without joints"
    return FREE_MOTION, "where nothing slides" if system.touching else "in free motion"


def choose_prior(
    dataset: Dataset, system: MechanicalSystem, *, noise: Noise | None = None, seed: int = 0, **how: Any
) -> tuple[str, str]:
    """Name of the prior to learn with, and why, in a sentence.

    In free motion friction of the joints, in contact forces at the tool, unless left-out stretches of `LOOK` rows show
    a force at every joint, or the sum with friction of the joints, to be better (`compare_priors`, whose other
    arguments are `how`). Of a robot that flies, what air does; feet that stand are no contact in which something
    slides. A system with friction laws was identified: what is missing is the rest of the friction, and functions of
    positions and torques only fit what filters leave. Where nothing can be compared (too few rows), the first one is
    taken as well, and the reason says so.
    """
    names, where = _looked_at(system)
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


EQUATIONS = 2_800
"""Of the rows that a search learns from at once, at most: 400 rows of an arm. Its time grows with their cube."""


def all_rows_at_once(count: int, nv: int) -> dict[str, Any]:
    """Arguments for the `fit` of functions of few inputs to so many rows of nv equations: exact up to a few hundred.

    Beyond, by inducing points that leave out less than what one number adds to the variance of a row, 1 / count: what
    all rows leave open of a function is small, and intervals of curves hold what is left out, too. Hyper-parameters are
    improved on all rows afterwards (`allowing_for_correlation`).
    """
    most = min(MOST_POINTS_FOR_RESTARTS, EQUATIONS // nv)
    return {} if count <= most else {"engine": Inducing(tolerance=1.0 / count, refine=0), "learning_points": most}


def with_force_noise(model: StructuredGP, dataset: Dataset) -> StructuredGP:
    """The model with a learned noise of the joint forces beside that of accelerations, where it may learn its noise.

    Forces that are wrong by the same everywhere are accelerations that are wrong by more where the inertia is small:
    taken for noise of the acceleration, all rows of a two-joint arm made friction worse than none. It begins at the
    scatter of the forces that the known physics lacks.
    """
    noise = model.noise
    if noise is None or not noise.learn or noise.force is not None or model.system.robot.nv == 1:
        return model
    some = dataset.rows(slice(None, None, max(1, len(dataset) // RESIDUALS_OF_FORCES)))
    q, v, u, a = (torch.tensor(x, device=model.system.robot.device) for x in (some.q, some.v, some.u, some.a))
    dynamics = model.system.dynamics(q, v, u)
    residual = (a - dynamics.acceleration_map(known=model.mean == "analytical").offset)[..., None]
    forces = (torch.linalg.pinv(dynamics.H, rtol=1e-8) @ residual)[..., 0].std(0)
    if not float(forces.min()) > 0.0:
        return model
    return replace(model, noise=replace(noise, force=tuple(forces.tolist())))


def allowing_for_correlation(
    posterior: StructuredPosterior, dataset: Dataset, hyperprior: bool = True
) -> tuple[StructuredPosterior, str | None]:
    """The posterior from all rows of a log, learned from them as the independent rows that they are worth; and a note.

    Errors of filtered and resampled logs resemble each other from row to row; taken for independent, 20,000 rows would
    count as 20,000 facts. With the integrated correlation time k of the residuals, in rows, every row counts as 1/k
    (`analytical.least_squares.correlation_time`, `TrainingData`), for the functions and for hyper-parameters, which
    inducing points then improve on all rows. No row is left out, for friction changes within a few of them at a
    reversal. The note is None where errors do not resemble each other.
    """
    k, some = 1.0, dataset.rows(slice(RESIDUALS))
    if dataset.time_ordered:
        residual = posterior.predict(some.q, some.v, some.u, covariance=False).mean.cpu().numpy() - some.a
        spread = residual.std(axis=0)
        k = float(np.median(correlation_time(residual / np.where(spread > 0.0, spread, 1.0), some.episode)))
    k = k if k >= NOTICEABLE else 1.0
    if k > 1.0:
        settings = {**posterior.settings, "correlated_rows": k}
        given = posterior.training, posterior.parameters, posterior.result, settings, posterior.engine
        found = posterior.model.condition(*given)
        assert isinstance(found, StructuredPosterior)
        posterior = found
    if isinstance(posterior.engine, Inducing):
        posterior = refined(replace(posterior, engine=replace(posterior.engine, refine=Inducing.refine)), hyperprior)
    return posterior, f"errors resemble each other over {k:.0f} rows, which count as one" if k > 1.0 else None
