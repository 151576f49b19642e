"""Plot: error and distance from the surface of roll-outs over time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.evaluation.plots.style import LARGE, legend_below, new_figure, quiet
from forcegp.experiments.model_names import MODELS
from forcegp.experiments.plots.learning_curves import COLORS

Arrays = Mapping[str, Mapping[str, Mapping[str, np.ndarray]]]
TITLES = {
    "baumgarte": "with Baumgarte (black boxes: none)",
    "none": "not stabilised",
    "projected": "projecting integrator",
}


MOST_DRAWN = 300
"""Points of a curve, about: more than the eye sees would make megabytes of vector graphics."""


def rollouts_figure(arrays: Arrays, title: str) -> Figure:
    """Joint error above (diverged: infinite), distance from the surface below (of those that have not diverged)."""
    figure = new_figure(11.0, 6.0)
    figure.suptitle(title, fontsize=LARGE, x=0.01, ha="left")
    panels = figure.subplots(2, len(TITLES), sharex=True, sharey="row")
    for column, (variant, heading) in enumerate(TITLES.items()):
        shown = dict(arrays[variant])
        if variant == "baumgarte":
            shown = {model: each for model, each in arrays["none"].items() if model not in shown} | shown
        for model, whole in shown.items():
            every = max(1, len(whole["time"]) // MOST_DRAWN)
            stored = {name: rows[..., ::every] for name, rows in whole.items()}
            gone = np.isnan(stored["joint_error"])
            _draw(panels[0, column], stored["time"], np.where(gone, np.inf, stored["joint_error"]), model)
            _draw(panels[1, column], stored["time"], _of_the_living(stored["constraint"], gone), model)
        quiet(panels[0, column], title=heading, y="mean |q − q recorded| [rad]" if column == 0 else "")
        quiet(panels[1, column], x="time [s]", y="|c(q)| [m]" if column == 0 else "")
    for axes in panels.flat:
        axes.set_yscale("log")
    panels[0, 0].set_ylim(1e-6, 1e1)
    panels[1, 0].set_ylim(1e-17, 1e0)
    legend_below(figure, panels[0, 0])
    return figure


def _of_the_living(values: np.ndarray, gone: np.ndarray) -> np.ndarray:
    """The values of motions that have not diverged; where fewer than half are left, of none."""
    few = gone.mean(axis=0) > 0.5
    left = np.where(gone, np.nan, values)
    filled = np.where(gone, np.nanmedian(np.where(few, 0.0, left), axis=0), left)
    return np.where(few, np.nan, filled)


def _draw(axes: Axes, time: np.ndarray, values: np.ndarray, model: str) -> None:
    """Median over the motions, and the range from the 10th to the 90th percentile."""
    low, middle, high = np.quantile(np.maximum(values, 1e-18), (0.1, 0.5, 0.9), axis=0, method="nearest")
    high, middle = np.where(np.isinf(high), 1e3, high), np.where(np.isinf(middle), np.nan, middle)
    axes.fill_between(time, low, high, color=COLORS[model], alpha=0.12, linewidth=0)
    axes.plot(time, middle, color=COLORS[model], linewidth=1.2, label=MODELS[model].label)
