"""Plot: the predicted acceleration of every joint with its 2-sigma band, and its error on a scale of its own."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.data import Dataset
from forcegp.evaluation.plots import style
from forcegp.evaluation.predicted_rows import PredictedRows, predict_rows
from forcegp.models.protocol import Posterior


def prediction_figure(posterior: Posterior, dataset: Dataset, *, start: float = 0.0, seconds: float = 4.0) -> Figure:
    """One row per joint: acceleration on the left, errors on the right, over `seconds` of the first episode.

    The dark band is 2 sigma of the acceleration, the light one adds the measurement noise.
    """
    rows = style.window(dataset, start, seconds)
    predicted = predict_rows(posterior, rows)
    figure = style.new_figure(11.0, 1.0 + 1.35 * rows.nv)
    axes = figure.subplots(rows.nv, 2, sharex=True, squeeze=False, width_ratios=(1.25, 1.0))
    names, units = style.short_joint_names(rows.joint_names), style.joint_units(rows, "a")
    for joint in range(rows.nv):
        draw_acceleration(axes[joint, 0], rows, predicted, joint)
        draw_error(axes[joint, 1], rows, predicted, joint)
        style.quiet(axes[joint, 0], y=f"{names[joint]}\n{units[joint]}")
        style.quiet(axes[joint, 1], y=units[joint])
    for column, title in enumerate(("Acceleration", "Error: prediction minus measurement (dots) or truth (line)")):
        axes[0, column].set_title(title, fontsize=style.NORMAL, loc="left")
        axes[-1, column].set_xlabel("time in s", fontsize=style.NORMAL)
    figure.align_ylabels(axes[:, 0])
    figure.align_ylabels(axes[:, 1])
    title = f"Prediction after {len(posterior.training)} training points"
    style.legend_above(figure, title, axes[0, 0], axes[0, 1], markerscale=4)
    return figure


def draw_acceleration(axes: Axes, rows: Dataset, predicted: PredictedRows, joint: int) -> None:
    """Measurement, band, truth and mean of one joint over time."""
    time, mean, spread = rows.time, predicted.mean[:, joint], 2.0 * predicted.std[:, joint]
    axes.plot(time, rows.a[:, joint], ".", color=style.MEASUREMENT, markersize=1.8, alpha=0.7, label="measured")
    style.draw_band(axes, time, mean, spread, alpha=0.35, label="2σ")
    if "a" in rows.truth:
        axes.plot(time, rows.truth["a"][:, joint], color=style.TRUTH, linewidth=1.0, label="true")
    axes.plot(time, mean, color=style.PREDICTION, linewidth=1.3, linestyle=style.DASHED, label="predicted")
    axes.margins(x=0)


def draw_error(axes: Axes, rows: Dataset, predicted: PredictedRows, joint: int) -> None:
    """Errors of one joint over time, about the bands of 2 sigma without and with measurement noise."""
    time, mean = rows.time, predicted.mean[:, joint]
    inner, outer = 2.0 * predicted.std[:, joint], 2.0 * predicted.measurement_std[:, joint]
    style.draw_band(axes, time, np.zeros_like(mean), outer, alpha=0.13, label="2σ of a measurement")
    style.draw_band(axes, time, np.zeros_like(mean), inner, alpha=0.35)
    axes.plot(time, mean - rows.a[:, joint], ".", color=style.MEASUREMENT, markersize=1.8, alpha=0.7)
    if "a" in rows.truth:
        axes.plot(time, mean - rows.truth["a"][:, joint], color=style.TRUTH, linewidth=1.0)
    axes.axhline(0.0, color=style.PREDICTION, linewidth=0.8, linestyle=style.DASHED)
    axes.margins(x=0)
    limit = 2.0 * float(np.median(outer))
    if np.abs(mean - rows.a[:, joint]).max() < 1.5 * limit:  # equal scales where the model is right
        axes.set_ylim(-limit, limit)
