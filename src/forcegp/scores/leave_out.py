"""Which unknown force do the data support? Models fitted once, and stretches of time left out in closed form.

The score is the log predictive density of the stretches (`posterior.leave_out`), not the marginal likelihood: models
differ in the number of parameters by a factor of thirty, and their searches end at optima of different quality; the
left-out density charges both where it hurts.
"""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from forcegp.data import Dataset, farthest_rows, time_blocks
from forcegp.errors import ForceGPError, InvalidInput
from forcegp.fit import default_options, fit
from forcegp.model import Model
from forcegp.robots.arguments import whole_number
from forcegp.scores.accuracy import ALL_JOINTS, STRETCHES
from forcegp.scores.candidates import kind_of
from forcegp.scores.learning import named_model, summands
from forcegp.scores.scores import Scores

FEWEST_STRETCHES = 3


def leave_out(
    models: Mapping[str, Model | str],
    log: Dataset,
    given: Model,
    *,
    points: int,
    restarts: int | None,
    iterations: int | None,
    about: Mapping[str, Any],
) -> Scores:
    """Densities of `models`, which may be names of forces, on the rows of `log` that lie farthest apart.

    Raises InvalidInput for models that cannot leave rows out, and for rows of too few stretches; NotEnoughMemory: the
    exact covariances of the rows do not fit.
    """
    if not isinstance(models, Mapping) or len(models) < 2:
        raise InvalidInput("there is nothing to compare; give models={name: model, ...} with two or more.")
    rows = log
    if whole_number("points", points, 2, 10**9, "rows") < len(log):
        rows = farthest_rows(log, points)
    lasting = sum(float(np.ptp(rows.time[rows.episode == episode])) for episode in rows.episodes)
    if not lasting > 0.0:
        raise InvalidInput("every episode has one training row, so there are no stretches of time to leave out.")
    blocks = time_blocks(rows.time, rows.episode, lasting / STRETCHES)
    if len(blocks) < FEWEST_STRETCHES:
        raise InvalidInput(f"the rows fall into {len(blocks)} stretches of time, too few to compare by; give more.")
    options = default_options(len(rows))
    options = options if iterations is None else replace(options, iterations=iterations)
    runs, kinds, posteriors = {}, {}, {}
    for name, each in models.items():
        begin = time.process_time()
        try:
            model = named_model(given, summands(each)) if isinstance(each, str) else each
            # whatever the number of rows: no other engine can leave rows out
            posterior: Any = fit(model, rows, engine="exact", restarts=restarts, options=options)
        except ForceGPError as error:
            raise type(error)(f"forces {name!r}: {error}") from error
        density = -posterior.leave_out(blocks).log_density.numpy()
        # per row, so that their mean is that of all rows
        stretches = density * len(blocks) / len(rows)
        table = {ALL_JOINTS: {"nlpd": [float(stretches.mean())]}}
        run = {"split": "leave-out", "seed": 0, "error": None, "table": table, "motions": None, "warnings": []}
        run |= {"stretches": {"density": stretches.tolist()}, "mass_matrix": "none"}
        run |= {"cpu_seconds": time.process_time() - begin}
        runs[name], posteriors[name] = [run], posterior
        kinds[name] = {"kind": kind_of(posterior.model), "summary": posterior.description}
    about = {**about, "splits": [], "seeds": [0], "mass_matrix": []}
    about |= {"stretch": lasting / STRETCHES, "points": len(rows)}
    names = tuple(log.joint_names)
    return Scores(models=kinds, runs=runs, joint_names=names, units={}, about=about, posteriors=posteriors)
