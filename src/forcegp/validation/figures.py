"""Figures of a comparison: errors per joint, calibration, and errors of predicted motions against their length."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.evaluation.plots import style

LINE_STYLES = ("-", "--", ":")
"""For models beyond the number of colours."""


def figures_of(document: Mapping[str, Any]) -> dict[str, Figure]:
    """File name without ending -> figure; those for which there are numbers."""
    models = {name: model for name, model in document["models"].items() if model["runs"]}
    if not models:
        return {}
    figures = {"errors": errors_figure(models, document), "calibration": calibration_figure(models)}
    moving = {name: model for name, model in models.items() if model["motions"] is not None}
    if moving and all(model["motions"]["horizons"] for model in moving.values()):
        figures["motions"] = motions_figure(moving, document)
    return figures


def errors_figure(models: Mapping[str, Any], document: Mapping[str, Any]) -> Figure:
    """Normalised errors of accelerations above, force errors below: the median and the range over runs, by joint."""
    joints = style.short_joint_names(document["joint_names"])
    figure = style.new_figure(max(7.0, 1.3 * len(joints) + 2.0), 6.4)
    above, below = figure.subplots(2, 1, sharex=True)
    units = document["units"]["u"]
    unit = units if isinstance(units, str) else "/".join(dict.fromkeys(units))
    for axes, score, title, label in (
        (above, "nrmse", "Acceleration: RMSE over the standard deviation of the target", "nRMSE"),
        (below, "force_rms", "Force space: RMS of M (predicted − measured acceleration)", f"{unit}"),
    ):
        _points(axes, models, f"{score}_per_joint", len(joints))
        style.quiet(axes, title=title, y=label)
        axes.set_yscale("log")
    below.set_xticks(range(len(joints)), joints, fontsize=style.SMALL)
    _legend(figure, above, len(models))
    return figure


def _points(axes: Axes, models: Mapping[str, Any], score: str, joints: int) -> None:
    width = 0.8 / len(models)
    for place, (name, model) in enumerate(models.items()):
        known = [(joint, value) for joint, value in enumerate(model[score]) if value is not None]
        at = np.array([joint + (place + 0.5) * width - 0.4 for joint, _ in known])
        middle, low, high = (np.array([value[key] for _, value in known]) for key in ("median", "min", "max"))
        color, marker = _color(place), "os^"[place // len(style.SERIES) % 3]
        below_and_above = np.vstack([middle - low, high - middle])
        looks = {"fmt": marker, "markersize": 4.5, "color": color, "elinewidth": 1.2}
        axes.errorbar(at, middle, yerr=below_and_above, label=name, **looks)
    for joint in range(joints - 1):
        axes.axvline(joint + 0.5, color="#DDE0E4", linewidth=0.7)


def calibration_figure(models: Mapping[str, Any]) -> Figure:
    """The share of held-out accelerations inside the central intervals, against the share that should be."""
    figure = style.new_figure(5.6, 5.0)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color=style.TRUTH, linewidth=1.0)
    for place, (name, model) in enumerate(models.items()):
        levels = model["calibration"]["levels"]
        middle = [covered["median"] for covered in model["calibration"]["covered"]]
        axes.plot(
            levels, middle, _style(place), color=_color(place), linewidth=1.4, marker="o", markersize=3, label=name
        )
    style.quiet(
        axes, title="Calibration, mean over joints, median over runs", x="nominal interval", y="held-out rows inside"
    )
    axes.set_aspect("equal")
    axes.annotate("too narrow", (0.72, 0.2), fontsize=style.NORMAL, color=style.QUIET)
    axes.annotate("too wide", (0.1, 0.72), fontsize=style.NORMAL, color=style.QUIET)
    _legend(figure, axes, len(models))
    return figure


def motions_figure(models: Mapping[str, Any], document: Mapping[str, Any]) -> Figure:
    """RMS error of q over motions and joints against the length of the prediction: median and range over runs."""
    figure = style.new_figure(6.4, 4.6)
    axes = figure.subplots()
    for place, (name, model) in enumerate(models.items()):
        motions = model["motions"]
        known = [(h, rms) for h, rms in zip(motions["horizons"], motions["rms"], strict=True) if rms is not None]
        if not known:
            continue
        time = [h for h, _ in known]
        low, middle, high = ([rms[key] for _, rms in known] for key in ("min", "median", "max"))
        axes.plot(
            time, middle, _style(place), color=_color(place), linewidth=1.5, marker="o", markersize=3.5, label=name
        )
        axes.fill_between(time, low, high, color=_color(place), alpha=0.10, linewidth=0)
    units = document["units"]["q"]
    unit = units if isinstance(units, str) else "/".join(dict.fromkeys(units))
    title = "Motions predicted from recorded states under recorded forces"
    style.quiet(axes, title=title, x="length of the prediction [s]", y=f"RMS error of q [{unit}]")
    axes.set_yscale("log")
    _legend(figure, axes, len(models))
    return figure


LINE, LETTER = 0.6, 0.075
"""Inches that the line and a letter of a legend's entry take."""


def _legend(figure: Figure, axes: Axes, count: int) -> None:
    longest = max(map(len, axes.get_legend_handles_labels()[1]), default=0)
    fitting = max(1, int(figure.get_figwidth() / (LINE + LETTER * longest)))
    style.legend_below(figure, axes, columns=min(count, 4, fitting), labelcolor=style.QUIET)


def _color(place: int) -> str:
    return style.SERIES[place % len(style.SERIES)]


def _style(place: int) -> str:
    return LINE_STYLES[place // len(style.SERIES) % len(LINE_STYLES)]
