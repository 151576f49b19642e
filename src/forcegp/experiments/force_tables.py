"""Tables and bars of the experiments on force priors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from forcegp.experiments.experiment import markdown_table, shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def score_table(trials: Iterable[Mapping[str, Any]], columns: Sequence[str], tested_on: bool = False) -> str:
    """One row per trial and test, medians and ranges over seeds."""
    head = ["model", "points", *(["tested on"] if tested_on else []), *(COLUMNS[name][0] for name in columns)]
    rows = [
        [
            trial["label"],
            str(trial["points"]),
            *([label] if tested_on else []),
            *(shown(scores.get(name), COLUMNS[name][1]) for name in columns),
        ]
        for trial in trials
        for label, scores in trial["tests"].items()
    ]
    return markdown_table(head, rows)


def only_test(trial: Mapping[str, Any]) -> Mapping[str, Any]:
    """The scores of a trial that was tested on one scenario."""
    (scores,) = trial["tests"].values()
    return scores


def bars_figure(groups: Mapping[str, Mapping[str, Mapping[str, Any]]], score: str, label: str) -> Figure:
    """Group -> model -> scores: one panel per group, a bar per model, the range over seeds as a line."""
    from forcegp.evaluation.figure_style import QUIET, SERIES, new_figure, quiet

    models = list(dict.fromkeys(model for scores in groups.values() for model in scores))
    figure = new_figure(3.4 * len(groups) + 0.6, 0.34 * max(len(scores) for scores in groups.values()) + 1.3)
    panels = figure.subplots(1, len(groups), squeeze=False)[0]
    for axes, (group, scores) in zip(panels, groups.items(), strict=True):
        for place, (model, values) in enumerate(scores.items()):
            value = values[score]
            color = SERIES[models.index(model) % len(SERIES)]
            axes.barh(place, value["median"], color=color, height=0.62)
            axes.plot([value["min"], value["max"]], [place, place], color=QUIET, linewidth=1.2)
            axes.annotate(
                f"{value['median']:.3g}", (value["max"], place), (4, 0), textcoords="offset points", va="center", size=7
            )
        axes.set_yticks(range(len(scores)), list(scores))
        axes.invert_yaxis()
        axes.set_xscale("log")
        lowest = min(values[score]["min"] for values in scores.values())
        highest = max(values[score]["max"] for values in scores.values())
        axes.set_xlim(0.5 * lowest, 4.0 * highest)
        quiet(axes, title=group, x=label, y="")
    return figure
