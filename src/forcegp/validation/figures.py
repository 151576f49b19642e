"""Figures of a comparison: errors per joint, calibration, and errors of predicted motions against their length."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.evaluation.plots import style

LINE_STYLES, MARKERS = ("-", "--", ":"), "os^"
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
    for axes, score, title, label in (
        (above, "nrmse", "Acceleration: RMSE over the standard deviation of the target", "nRMSE"),
        (below, "force_rms", "Force space: RMS of M (predicted − measured acceleration)", _unit(document, "u")),
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
        looks = {"fmt": MARKERS[place // len(style.SERIES) % 3], "markersize": 4.5, "elinewidth": 1.2}
        around = np.vstack([middle - low, high - middle])
        axes.errorbar(at, middle, yerr=around, label=name, color=_color(place), **looks)
    for joint in range(joints - 1):
        axes.axvline(joint + 0.5, color="#DDE0E4", linewidth=0.7)


def calibration_figure(models: Mapping[str, Any]) -> Figure:
    """The share of held-out accelerations inside the central intervals, against the share that should be."""
    figure = style.new_figure(5.6, 5.0)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color=style.TRUTH, linewidth=1.0)
    for place, (name, model) in enumerate(models.items()):
        middle = [covered["median"] for covered in model["calibration"]["covered"]]
        _draw_curve(axes, place, name, model["calibration"]["levels"], middle)
    title = "Calibration, mean over joints, median over runs"
    style.quiet(axes, title=title, x="nominal interval", y="held-out rows inside")
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
        _draw_curve(axes, place, name, time, middle)
        axes.fill_between(time, low, high, color=_color(place), alpha=0.10, linewidth=0)
    title, label = "Motions predicted from recorded states under recorded forces", _unit(document, "q")
    style.quiet(axes, title=title, x="length of the prediction [s]", y=f"RMS error of q [{label}]")
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


def _draw_curve(axes: Axes, place: int, name: str, x: Sequence[float], y: Sequence[float]) -> None:
    looks = {"linestyle": LINE_STYLES[place // len(style.SERIES) % len(LINE_STYLES)], "marker": "o", "markersize": 3.0}
    style.draw_line(axes, x, y, _color(place), 1.4, name, **looks)


def _unit(document: Mapping[str, Any], quantity: str) -> str:
    units = document["units"][quantity]
    return units if isinstance(units, str) else "/".join(dict.fromkeys(units))
