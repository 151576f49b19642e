"""The model that a comparison recommends, fitted to all of its rows."""

from collections.abc import Mapping
from typing import Any

from forcegp.posterior import Posterior
from forcegp.validation.candidates import candidate, identified_model
from forcegp.validation.comparison import Comparison

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
    assert comparison.identification is not None, "it is resolved"
    work, rows = candidate(name, comparison.model, comparison.identification), comparison.rows
    own = work.identification
    identified = None if own is None else identified_model(own, comparison.model, rows)
    return work.fit(comparison.training(rows, comparison.recording, identified, seed))
