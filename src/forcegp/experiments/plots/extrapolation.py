"""Plot: error inside and outside of where each model was trained."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.evaluation.plots.style import QUIET, legend_below, new_figure, quiet
from forcegp.experiments.extrapolation_jobs import REGIONS
from forcegp.experiments.model_names import MODELS, NETWORKS
from forcegp.experiments.plots.learning_curves import COLORS


def extrapolation_figure(summary: Mapping[str, Any]) -> Figure:
    """One panel per region: for each model the MAE inside (hollow) and outside (filled), with the range over seeds."""
    figure = new_figure(10.0, 3.8)
    panels = figure.subplots(1, len(REGIONS), sharey=True, sharex=True)
    for axes, (region, label) in zip(panels, REGIONS.items(), strict=True):
        models = summary["regions"][region]
        for place, (model, scores) in enumerate(models.items()):
            _draw_model(axes, -place, scores, COLORS[model])
        axes.set_yticks([-place for place in range(len(models))], [_label(model, models[model]) for model in models])
        axes.set_xscale("log")
        quiet(axes, title=f"tested in the {label}", x="MAE against noise-free accelerations [rad/s²]")
        axes.tick_params(axis="y", length=0)
    panels[0].plot([], [], "o", color=QUIET, markerfacecolor="white", label="inside: where it was trained")
    panels[0].plot([], [], "o", color=QUIET, label="outside")
    legend_below(figure, panels[0])
    return figure


def _label(model: str, scores: Mapping[str, Any]) -> str:
    points = "all rows" if model in NETWORKS else f"{scores['points']['median']:.0f} points"
    return f"{MODELS[model].label} ({points})"


def _draw_model(axes: Axes, place: int, scores: Mapping[str, Any], color: str) -> None:
    inside, outside = (scores[side]["mae_noise_free"] for side in ("inside", "outside"))
    axes.plot([inside["median"], outside["median"]], [place, place], color=color, linewidth=1.0, alpha=0.5)
    for value, face in ((inside, "white"), (outside, color)):
        axes.plot([value["min"], value["max"]], [place, place], color=color, linewidth=3.0, alpha=0.35)
        axes.plot(value["median"], place, "o", color=color, markerfacecolor=face, markersize=6)
