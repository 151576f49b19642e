"""Which unknown force do the data support? Models fitted once, and stretches of time left out in closed form.

The score is the log predictive density of the stretches (`posterior.leave_out`), not the marginal likelihood: models
differ in the number of parameters by a factor of thirty, and their searches end at optima of different quality; the
left-out density charges both where it hurts.
"""

import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from forcegp.data import Dataset, farthest_rows, time_blocks
from forcegp.errors import DataWarning, ForceGPError, InvalidInput
from forcegp.fit import default_options, fit
from forcegp.forces import Viscous
from forcegp.model import Model
from forcegp.robots.arguments import whole_number
from forcegp.scores.accuracy import ALL_JOINTS, STRETCHES
from forcegp.scores.candidates import kind_of
from forcegp.scores.learning import looked_at, named_model, summands
from forcegp.scores.scores import Scores

FEWEST_STRETCHES = 3
LOOK = 100  # rows


def leave_out(
    models: Mapping[str, Model | str],
    log: Dataset,
    given: Model,
    *,
    points: int = LOOK,
    restarts: int | None = None,
    iterations: int | None = None,
    seed: int = 0,
    about: Mapping[str, Any] | None = None,
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
            posterior: Any = fit(model, rows, engine="exact", restarts=restarts, seed=seed, options=options)
        except ForceGPError as error:
            raise type(error)(f"forces {name!r}: {error}") from error
        density = -posterior.leave_out(blocks).log_density.numpy()
        # per row, so that their mean is that of all rows
        stretches = density * len(blocks) / len(rows)
        table = {ALL_JOINTS: {"nlpd": [float(stretches.mean())]}}
        run = {
            "split": "leave-out",
            "seed": 0,
            "error": None,
            "table": table,
            "stretches": {"density": stretches.tolist()},
        }
        run |= {"motions": None, "warnings": []}
        run |= {"cpu_seconds": time.process_time() - begin, "mass_matrix": "none"}
        runs[name], posteriors[name] = [run], posterior
        kinds[name] = {"kind": kind_of(posterior.model), "summary": posterior.description}
    about = {
        **(about or {}),
        "splits": [],
        "seeds": [0],
        "mass_matrix": [],
        "stretch": lasting / STRETCHES,
        "points": len(rows),
    }
    names = tuple(log.joint_names)
    return Scores(models=kinds, runs=runs, joint_names=names, units={}, about=about, posteriors=posteriors)


def choose_forces(dataset: Dataset, model: Model, *, seed: int = 0, iterations: int | None = None) -> tuple[str, str]:
    """The unknown forces to learn, joined by "+", and why, in a sentence.

    In free motion friction of the joints, in contact forces at the tool, unless left-out stretches of `LOOK` rows show
    a force at every joint, or the sum with friction of the joints, to be better. Of a robot that flies, what air does;
    feet that stand are no contact in which something slides. A model with friction laws was identified: what is missing
    is the rest of the friction, and functions of positions and torques only fit what filters leave. Where nothing can
    be compared (too few rows), the first one is taken as well, and the reason says so.
    """
    names, where = looked_at(model)
    first, *others = names
    if any("level" in law.coefficients or isinstance(law, Viscous) for law in model.laws):
        return first, f"{first} {where}, beside the friction laws that the model lists"
    points = min(LOOK, len(dataset))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # the fit gives it
            how: dict[str, Any] = {"points": points, "restarts": 1, "iterations": iterations, "seed": seed}
            found = leave_out({name: name for name in names}, dataset, model, **how)
    except ForceGPError as error:
        return first, f"{first}, the usual one {where}; others could not be compared with it ({error})"
    by = f"left-out stretches of {found.about['stretch']:.3g} s of {points} rows"
    best = min(others, key=lambda name: found.value("nlpd", ALL_JOINTS, name) or 0.0)
    gain = found.difference("density", best, first)
    if gain is None or gain.outcome != "better":
        return first, f"{first} {where}; {by} do not show {', '.join(others)} to be better"
    return best, f"{best} {where}; by {by} it is better than {first}, by {-gain.value:.3g} nats per row"
