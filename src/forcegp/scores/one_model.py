"""One model on one test log: the table of rows and motions, and what a reader has to know beside it."""

from collections.abc import Callable
from typing import Any

from forcegp.data import Dataset, contact_doubts
from forcegp.posterior import observing
from forcegp.posterior.posterior import Posterior
from forcegp.scores.accuracy import Matrices, row_scores
from forcegp.scores.doubts import doubts, overlap_warnings
from forcegp.scores.motions import HeldOutMotions, motion_scores

OBSERVED = "wind, and the force that stays unexplained, were observed from the rows before each."


def scored(
    posterior: Posterior,
    test: Dataset,
    motions: HeldOutMotions,
    integrator: str = "rk4",
    mass: Matrices | None = None,
    *,
    fitted_here: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """The table, errors by stretch and motion, and warnings, as plain JSON values.

    Where the model has observers (`forcegp.posterior.observing`), they see the rows before each one. Rows that training
    and test share are named unless the model was `fitted_here`, to the other side of a split.
    """
    alone, recorded = posterior, test
    if test.time_ordered:
        posterior, test = observing(posterior, test, whole=True)
    table, stretches = row_scores(posterior, test, mass, progress)
    moving, facts = motion_scores(alone, motions, integrator)
    before = [] if fitted_here else [*overlap_warnings(alone, recorded), *contact_doubts(test, posterior.model)]
    told = [str(doubt) for doubt in (*before, *doubts(posterior, test, table))]
    told += [] if posterior is alone else [OBSERVED]
    return {"table": table | moving, "stretches": stretches, "motions": facts, "warnings": told, "test_rows": len(test)}
