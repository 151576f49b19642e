"""Plot: errors of the tool's mass and centre of mass, and the prediction error, against the iteration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from forcegp.evaluation.plots.style import QUIET, legend_below, new_figure, quiet
from forcegp.experiments import published
from forcegp.experiments.fig2c_jobs import CENTER_BOUND, MASS_BOUND, MEANS, MODELS
from forcegp.experiments.plots.learning_curves import COLORS

PANELS = (
    ("mass_error", "|mass error| of the tool [kg]", MASS_BOUND),
    ("center_error", "error of its centre of mass [m]", CENTER_BOUND),
    ("mae", "MAE against noisy accelerations [rad/s²]", None),
)
LINES = {"analytical": "-", "zero": ":"}


def estimation_figure(summary: Mapping[str, Any]) -> Figure:
    """Figure 2c: ours as lines, the published values as crosses."""
    figure = new_figure(11.0, 4.0)
    panels = figure.subplots(1, len(PANELS))
    for axes, (name, title, bound) in zip(panels, PANELS, strict=True):
        for model, means in summary["traces"].items():
            for mean, trace in means.items():
                values = [abs(value) for value in trace[name]]
                label = f"{MODELS[model]} {MEANS[mean]}"
                axes.plot(values, color=COLORS[model], linestyle=LINES[mean], linewidth=1.4, label=label)
        if bound is not None:
            axes.axhline(bound, color=QUIET, linewidth=0.8)
        for model, values in published.FIG2C.items():
            points = values.get(name, {})
            errors = [abs(value) for value in points.values()]
            axes.plot(list(points), errors, "x", color=COLORS[model], markersize=6)
        axes.set_yscale("log")
        axes.set_xscale("symlog", linthresh=10)
        axes.set_xlim(0, 450)
        axes.set_xticks([0, 5, 10, 40, 100, 400], ["0", "5", "10", "40", "100", "400"])
        quiet(axes, title=title, x="iteration")
    panels[0].plot([], [], "x", color=QUIET, label="published (2021)")
    legend_below(figure, panels[0], columns=5)
    return figure
