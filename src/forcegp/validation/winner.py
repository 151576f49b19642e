"""The model that a comparison recommends, fitted to all of its rows."""

from collections.abc import Mapping
from typing import Any

from forcegp.analytical import NoiseLevels
from forcegp.mechanics import MechanicalSystem
from forcegp.models import Posterior
from forcegp.validation.candidates import Training, candidate
from forcegp.validation.comparison import Comparison, identification_named, training_subset

ORDER = "motion", "force_rms", "nrmse"
"""Scores that decide, the first one that there is: where a robot goes is what simulators and controllers need."""


def recommended(document: Mapping[str, Any]) -> str | None:
    """The name of the model to take, of the document of a `Validation`; None where no model was scored."""
    scores = (document["winners"][score]["model"] for score in ORDER if score in document["winners"])
    return next(scores, None)


def fitted_on_all_rows(comparison: Comparison, name: str, seed: int = 0) -> Posterior:
    """The posterior of this model from all rows of the comparison, of which nothing is held out any more.

    Raises InvalidInput for names that are no model, and FitError where the fit fails.
    """
    work, rows = candidate(name, comparison.system, comparison.identification), comparison.rows
    identified: dict[str, MechanicalSystem | str] = {}
    levels: NoiseLevels | None = None
    if work.identification is not None:
        method = identification_named(work.identification)
        given = rows if method.all_rows else training_subset(rows, comparison.points, seed)
        identified[work.identification] = method.identify(comparison.system, given, comparison.friction)
        levels = None if method.noise is None else method.noise(comparison.system, given, comparison.friction)
    subset = training_subset(rows, comparison.points, seed)
    whole = rows, comparison.recording, max(comparison.horizons, default=1.0)
    return work.fit(Training(subset, comparison.system, identified, seed, *comparison.search, levels, *whole))
