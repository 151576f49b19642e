"""Plot: the accelerations that several models predict for the same window, with their 95 % intervals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from forcegp.evaluation.plots.style import MEASUREMENT, TRUTH, draw_band, legend_below, new_figure, quiet
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
            measured, color = stored["measured"][:, joint], COLORS[model]
            axes.plot(time, measured, ".", color=MEASUREMENT, markersize=1.5, label="measured", rasterized=True)
            draw_band(axes, time, mean, INTERVAL * std, color=color, alpha=0.3, label="95 % interval")
            axes.plot(time, mean, color=color, linewidth=1.2, label="prediction")
            axes.plot(time, stored["truth"][:, joint], color=TRUTH, linewidth=0.8, linestyle=":", label="truth")
            margin = 0.25 * (measured.max() - measured.min())
            axes.set_ylim(measured.min() - margin, measured.max() + margin)
            quiet(
                axes,
                title=MODELS[model].label if row == 0 else "",
                x="time [s]" if row == len(SHOWN_JOINTS) - 1 else "",
                y=f"joint {joint + 1} [rad/s²]" if column == 0 else "",
            )
    legend_below(figure, panels[0, -1])
    return figure
