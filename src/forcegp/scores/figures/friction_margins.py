"""How far feet are from slipping in the rows of a Dataset: numbers, and a plot over time."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from forcegp.data import Dataset
from forcegp.errors import ContactError
from forcegp.posterior.friction_margin import friction_margins
from forcegp.posterior.posterior import Posterior
from forcegp.scores.figures import style
from forcegp.scores.figures.style import QUANTILE
from forcegp.scores.predicted_rows import in_blocks


def slip_scores(posterior: Posterior, dataset: Dataset, coefficient: float) -> dict[str, dict[str, float]]:
    """Of every foot: its least margin [N] with standard deviation and row, and how likely it slips.

    "slipping" is the share of the rows in which it stands where P(slip) > 1/2, "expected" the mean of P(slip) over
    them, "most_likely" its largest. Feet that never stand have none. Raises as
    `friction_margins`, and ContactError where none stands.
    """
    names, parts = _margins(posterior, dataset, coefficient)
    scores = {}
    for foot, name in enumerate(names):
        mean, std, slip = (part[:, foot] for part in parts)
        if not (stands := np.isfinite(mean)).any():
            continue
        row = int(np.nanargmin(mean))
        scores[name] = {"least_margin": float(mean[row]), "std": float(std[row]), "row": row}
        scores[name] |= {"slipping": float((slip[stands] > 0.5).mean()), "expected": float(slip[stands].mean())}
        scores[name] |= {"most_likely": float(slip[stands].max())}
    if not scores:
        raise ContactError(
            "no foot stands in any of the rows, or a planar base bears its weight: there is no normal force to slip "
            "under. Check the flags of the contacts, or use base='floating'."
        )
    return scores


def friction_margins_figure(
    posterior: Posterior,
    dataset: Dataset,
    coefficient: float,
    *,
    start: float = 0.0,
    seconds: float = 4.0,
) -> Figure:
    """One row per foot: the margin mu N - |T| with its 95 % band over `seconds` of the first episode."""
    rows = style.window(dataset, start, seconds)
    names, (mean, std, _) = _margins(posterior, rows, coefficient)
    figure = style.new_figure(8.0, 1.0 + 1.5 * len(names))
    grid: Any = figure.subplots(len(names), 1, squeeze=False, sharex=True)[:, 0]
    for foot, axes in enumerate(grid):
        axes.axhline(0.0, color=style.KNOWN_PHYSICS, linewidth=1.1, label="slips below")
        style.draw_band(axes, rows.time, mean[:, foot], QUANTILE * std[:, foot], alpha=0.3, label="95 % band")
        style.draw_line(axes, rows.time, mean[:, foot], style.PREDICTION, 1.3, "margin to slipping")
        axes.margins(x=0)
        style.quiet(axes, title=names[foot], x="time [s]" if foot == len(names) - 1 else "", y="margin [N]")
    style.legend_above(figure, f"Friction coefficient {coefficient:g}", grid[0])
    return figure


def _margins(
    posterior: Posterior, dataset: Dataset, coefficient: float
) -> tuple[tuple[str, ...], list[Float[np.ndarray, "rows feet"]]]:
    """Names of the feet; mean, standard deviation and probability of slip in every row."""
    blocks = in_blocks(
        posterior,
        dataset,
        lambda rows: friction_margins(posterior, dataset.q[rows], dataset.v[rows], dataset.u[rows], coefficient),
    )
    names = ("mean", "std", "slip")
    return blocks[0].names, [np.concatenate([getattr(block, name).cpu().numpy() for block in blocks]) for name in names]
