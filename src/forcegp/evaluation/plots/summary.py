"""Plot: the whole story in one picture: where the tool went, what the model predicts, and the force it learned."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.evaluation.plots import style
from forcegp.evaluation.plots.tool_path import (
    draw_tool_path,
    excerpt,
    finish_tool_path,
    fit_figure_to_path,
    tool_path_title,
)
from forcegp.evaluation.predicted_rows import PredictedRows, predict_rows
from forcegp.models.protocol import Posterior


def summary_figure(
    posterior: Posterior,
    dataset: Dataset,
    *,
    start: float = 0.0,
    seconds: float = 4.0,
    joints: Sequence[int] | None = None,
) -> Figure:
    """The tool path, and below it, for three joints, the acceleration and the learned force against the truth.

    `joints` are columns of the Dataset; by default those where the learned force matters most for its own joint.
    Raises InvalidInput for joints that do not exist and for a system without contacts.
    """
    rows = style.window(dataset, start, seconds)
    predicted = predict_rows(posterior, rows)
    joints = _most_affected(predicted, 3) if joints is None else list(joints)
    if not joints or not all(0 <= joint < rows.nv for joint in joints):
        raise InvalidInput(f"joints are {joints}; give columns from 0 to {rows.nv - 1}.")
    figure = style.new_figure(10.0, 6.6)
    grid = figure.add_gridspec(3, len(joints), height_ratios=(1.15, 1.0, 1.0))
    top = figure.add_subplot(grid[0, :])
    lines = draw_tool_path(top, posterior, dataset, start=start)
    fit_figure_to_path(figure, top, least=1.4, most=2.0)
    finish_tool_path(figure, top, lines, tool_path_title(posterior.system, dataset, start=start))
    names = style.short_joint_names(rows.joint_names)
    units = {quantity: style.joint_units(rows, quantity) for quantity in ("a", "u")}
    for column, joint in enumerate(joints):
        above = figure.add_subplot(grid[1, column])
        below = figure.add_subplot(grid[2, column], sharex=above)
        _draw_acceleration(above, rows, predicted, joint)
        _draw_force(below, rows, predicted, joint)
        style.quiet(above, title=names[joint], y="" if column else f"acceleration in {units['a'][joint]}")
        style.quiet(below, x="time in s", y="" if column else f"unknown force in {units['u'][joint]}")
        above.tick_params(labelbottom=False)
    panels = figure.axes[-2:]
    figure.align_ylabels()
    style.legend_below(figure, *panels, size=style.NORMAL, markerscale=4)
    shown = excerpt(rows, dataset, before=" (time panels: ", after=")")
    style.heading(figure, f"{len(posterior.training)} points teach {_what(posterior)}{shown}", size=style.LARGE + 1)
    return figure


def _what(posterior: Posterior) -> str:
    if posterior.predicts_forces:
        return "the force that nobody modelled"
    return f"the {posterior.description} all it has learned"


def _draw_acceleration(axes: Axes, rows: Dataset, predicted: PredictedRows, joint: int) -> None:
    axes.plot(rows.time, rows.a[:, joint], ".", color=style.MEASUREMENT, markersize=2.0, label="measured")
    axes.plot(
        rows.time,
        predicted.known_physics[:, joint],
        color=style.KNOWN_PHYSICS,
        linewidth=1.1,
        label="known physics alone",
    )
    mean, spread = predicted.mean[:, joint], 2.0 * predicted.measurement_std[:, joint]
    style.draw_band(axes, rows.time, mean, spread, alpha=0.3, label="2σ")
    axes.plot(rows.time, mean, color=style.PREDICTION, linewidth=1.3, label="with the learned force")
    low, high = np.percentile(np.stack([rows.a[:, joint], predicted.known_physics[:, joint]]), (1, 99))
    axes.set_ylim(low - 0.15 * (high - low), high + 0.15 * (high - low))
    axes.margins(x=0)


def _draw_force(axes: Axes, rows: Dataset, predicted: PredictedRows, joint: int) -> None:
    mean, spread = predicted.moving_force[:, joint], 2.0 * np.sqrt(predicted.moving_force_variance[:, joint])
    if "a" in rows.truth:
        error = (predicted.mass @ (rows.truth["a"] - predicted.mean)[..., None])[..., 0]
        axes.plot(rows.time, mean + error[:, joint], color=style.TRUTH, linewidth=3.5, alpha=0.3, label="true force")
    style.draw_band(axes, rows.time, mean, spread, alpha=0.3)
    axes.plot(rows.time, mean, color=style.PREDICTION, linewidth=1.3)
    axes.margins(x=0)


def _most_affected(predicted: PredictedRows, count: int) -> list[int]:
    """The joints with the largest learned force in relation to their own inertia, in the order of the columns."""
    inertia = np.diagonal(predicted.mass, axis1=-2, axis2=-1)
    effect = np.abs(predicted.moving_force / inertia).mean(axis=0)
    return sorted(np.argsort(effect)[::-1][:count].tolist())
