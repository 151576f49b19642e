"""Plot: the accelerations that several models predict for the same window, with their 95 % intervals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from forcegp.evaluation.plots.style import MEASUREMENT, SMALL, TRUTH, new_figure, quiet
from forcegp.experiments.model_names import MODELS
from forcegp.experiments.plots.learning_curves import COLORS

SHOWN_JOINTS = (0, 3, 6)
INTERVAL = 1.96


def prediction_window_figure(arrays: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """Models side by side, joints 1, 4 and 7 below each other, all of one joint on the same scale."""
    figure = new_figure(11.0, 6.0)
    panels = figure.subplots(len(SHOWN_JOINTS), len(arrays), sharex=True, sharey="row", squeeze=False)
    for column, (model, stored) in enumerate(arrays.items()):
        for row, joint in enumerate(SHOWN_JOINTS):
            axes = panels[row, column]
            time, mean, std = stored["time"], stored["mean"][:, joint], stored["std"][:, joint]
            axes.plot(
                time,
                stored["measured"][:, joint],
                ".",
                color=MEASUREMENT,
                markersize=1.5,
                label="measured",
                rasterized=True,
            )
            axes.fill_between(
                time,
                mean - INTERVAL * std,
                mean + INTERVAL * std,
                color=COLORS[model],
                alpha=0.3,
                linewidth=0,
                label="95 % interval",
            )
            axes.plot(time, mean, color=COLORS[model], linewidth=1.2, label="prediction")
            axes.plot(time, stored["truth"][:, joint], color=TRUTH, linewidth=0.8, linestyle=":", label="truth")
            truth = stored["measured"][:, joint]
            margin = 0.25 * (truth.max() - truth.min())
            axes.set_ylim(truth.min() - margin, truth.max() + margin)
            quiet(
                axes,
                title=MODELS[model].label if row == 0 else "",
                x="time [s]" if row == len(SHOWN_JOINTS) - 1 else "",
                y=f"joint {joint + 1} [rad/s²]" if column == 0 else "",
            )
    figure.legend(
        *panels[0, -1].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=SMALL, frameon=False
    )
    return figure
