"""Tables and plots of the experiments on force priors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from textwrap import fill
from typing import Any

from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from forcegp.evaluation.plots.style import MEASUREMENT, PREDICTION, SMALL, TRUTH, new_figure, quiet
from forcegp.evaluation.summary_statistics import formatted, markdown_table

COLUMNS = {
    "mae": ("MAE", 4),
    "mae_noise_free": ("MAE noise-free", 4),
    "nlpd": ("NLPD", 2),
    "coverage_95": ("in 95 % band", 3),
    "normal_force_error": ("normal force, relative RMSE", 4),
    "normal_force_coverage": ("normal force in 95 % band", 3),
    "component_sum_error": ("sum of components [Nm]", 4),
    "mae_touching": ("MAE touching", 4),
    "mae_in_the_air": ("MAE in the air", 4),
}
"""Score -> heading and decimals."""


def score_table(trials: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> str:
    """One row per trial and test, medians and ranges over seeds."""
    head = ["model", "points", *(COLUMNS[name][0] for name in columns)]
    rows = [
        [trial["label"], str(trial["points"]), *(formatted(scores.get(name), COLUMNS[name][1]) for name in columns)]
        for trial in trials
        for scores in trial["tests"].values()
    ]
    return markdown_table(head, rows)


def only_test(trial: Mapping[str, Any]) -> Mapping[str, Any]:
    """The scores of a trial that was tested on one scenario."""
    (scores,) = trial["tests"].values()
    return scores


def dots_figure(groups: Mapping[str, Mapping[str, Mapping[str, Any]]], score: str, label: str) -> Figure:
    """Group -> model -> scores: one panel per group, a dot per model at the median, the range over seeds as a line.

    The first model of a group is what the others are compared with, and grey.
    """
    figure = new_figure(4.8 * len(groups), 0.32 * max(len(scores) for scores in groups.values()) + 1.3)
    panels = figure.subplots(1, len(groups), squeeze=False)[0]
    for axes, (group, scores) in zip(panels, groups.items(), strict=True):
        for place, model in enumerate(scores):
            value, color = scores[model][score], PREDICTION if place else MEASUREMENT
            axes.plot([value["min"], value["max"]], [place, place], color=color, linewidth=3.0, alpha=0.45)
            axes.plot(value["median"], place, "o", color=color, markersize=6.0)
            text = f"{value['median']:.3g}"
            beside = (value["max"], place)
            axes.annotate(text, beside, (7, 0), textcoords="offset points", va="center", fontsize=SMALL, color=TRUTH)
        axes.set_yticks(range(len(scores)), list(scores))
        axes.set_ylim(len(scores) - 0.5, -0.5)
        axes.set_xscale("log")
        lowest = min(values[score]["min"] for values in scores.values())
        highest = max(values[score]["max"] for values in scores.values())
        axes.set_xlim(0.6 * lowest, 2.5 * highest)
        plain_ticks(axes.xaxis)
        quiet(axes, title=fill(group, 44), x=label)
    return figure


def plain_ticks(axis: Axis) -> None:
    """Numbers such as 0.02 and 50 at 1, 2 and 5 times powers of ten of a logarithmic axis."""
    low, high = axis.get_view_interval()
    steps = (1.0, 2.0, 5.0) if high < 80.0 * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=steps))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
