"""Figures of the experiments."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from benchmarks.paper import published
from benchmarks.paper.fits import MODELS
from forcegp.scores.figures.style import (
    LARGE,
    QUANTILE,
    QUIET,
    SERIES,
    TRUTH,
    draw_band,
    legend_below,
    new_figure,
    quiet,
)

COLORS = dict(zip(MODELS, (SERIES[1], SERIES[4], SERIES[2], SERIES[0], SERIES[3], QUIET), strict=True))
"""One colour per model, the same in every figure."""


def plain_ticks(axis: Axis) -> None:
    """Numbers such as 0.02 and 50 on a logarithmic axis with its final limits: at powers of ten alone if it is long."""
    low, high = axis.get_view_interval()
    of_decades = LogLocator(subs=(1.0, 2.0, 5.0) if high < 80.0 * low else (1.0,))
    axis.set_major_locator(MaxNLocator(3) if high < 5.0 * low else of_decades)
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


PANELS = (
    ("mae", "MAE against noisy accelerations [rad/s²]"),
    ("mae_noise_free", "MAE against noise-free accelerations [rad/s²]"),
    ("constraint_error", "mean constraint error |A a − b| [m/s²]"),
)


def learning_curves_figure(summary: Mapping[str, Any]) -> Figure:
    """Figure 2b: ours as solid lines with the range over seeds, the paper's as dashed lines."""
    figure = new_figure(11.0, 4.4)
    panels = figure.subplots(1, len(PANELS))
    counts = sorted({int(count) for curve in summary["curves"].values() for count in curve})
    for axes, (score, heading) in zip(panels, PANELS, strict=True):
        paper = {"mae": published.FIG2B_MAE, "constraint_error": published.FIG2B_CONSTRAINT_ERROR}.get(score, {})
        for model, curve in summary["curves"].items():
            values = {int(count): scores[score] for count, scores in curve.items()}
            draw_range(axes, values, COLORS[model], MODELS[model].label)
        for model, values in paper.items():
            if model in summary["curves"]:
                line = {"color": COLORS[model], "linestyle": "--", "linewidth": 1.0, "alpha": 0.8}
                axes.plot(list(values), list(values.values()), **line)
        axes.set(xscale="log", yscale="log")
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.xaxis.set_minor_locator(NullLocator())
        if score != "constraint_error":
            plain_ticks(axes.yaxis)
        quiet(axes, title=heading, x="training points N", y="")
    panels[0].axhline(summary["noise_floor"], color=QUIET, linewidth=0.8)
    panels[0].annotate(
        "noise floor", (counts[0], summary["noise_floor"]), (0, -9), textcoords="offset points", fontsize=7, color=QUIET
    )
    panels[0].plot([], [], color=QUIET, linestyle="--", linewidth=1.0, label="published (2021)")
    legend_below(figure, panels[0], columns=5)
    return figure


def draw_range(axes: Axes, values: Mapping[int, Mapping[str, float]], color: str, label: str) -> None:
    """Count -> median and range over seeds: a line, and a band."""
    least, middle, largest = ([each[part] for each in values.values()] for part in ("min", "median", "max"))
    axes.fill_between(list(values), least, largest, color=color, alpha=0.15, linewidth=0)
    axes.plot(list(values), middle, color=color, marker="o", markersize=3.5, label=label)


SHOWN_JOINTS = (0, 3, 6)


def prediction_window_figure(arrays: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """Errors of models side by side, joints 1, 4 and 7 below each other; accelerations themselves would coincide."""
    figure = new_figure(11.0, 5.4)
    panels = figure.subplots(len(SHOWN_JOINTS), len(arrays), sharex=True, sharey="row", squeeze=False)
    for column, (model, stored) in enumerate(arrays.items()):
        for row, joint in enumerate(SHOWN_JOINTS):
            axes, time, half = panels[row, column], stored["time"], QUANTILE * stored["std"][:, joint]
            draw_band(axes, time, np.zeros_like(half), half, color=COLORS[model], alpha=0.35, label="95 % interval")
            error = stored["mean"][:, joint] - stored["truth"][:, joint]
            axes.plot(time, error, color=TRUTH, linewidth=0.9, label="prediction − truth")
            title, label = MODELS[model].label if row == 0 else "", f"joint {joint + 1} [rad/s²]" if column == 0 else ""
            quiet(axes, title=title, x="time [s]" if row == len(SHOWN_JOINTS) - 1 else "", y=label)
    for row, joint in enumerate(SHOWN_JOINTS):  # a few rows at the jumps of the reference would hide all others
        errors = [np.abs(each["mean"] - each["truth"])[:, joint] for each in arrays.values()]
        halves = [QUANTILE * each["std"][:, joint] for each in arrays.values()]
        limit = 1.2 * float(np.quantile([errors, halves], 0.98))
        panels[row, 0].set_ylim(-limit, limit)
    legend_below(figure, panels[0, -1])
    return figure


TITLES = {"baumgarte": "with Baumgarte (black boxes: none)", "none": "not stabilised"}
MOST_DRAWN = 300  # points of a curve, about: more than the eye sees would make megabytes of vector graphics


def rollouts_figure(arrays: Mapping[str, Mapping[str, Mapping[str, np.ndarray]]], title: str) -> Figure:
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
            _draw_motions(panels[0, column], stored["time"], np.where(gone, np.inf, stored["joint_error"]), model)
            _draw_motions(panels[1, column], stored["time"], _of_the_living(stored["constraint"], gone), model)
        quiet(panels[0, column], title=heading, y="mean |q − q recorded| [rad]" if column == 0 else "")
        quiet(panels[1, column], x="time [s]", y="|c(q)| [m]" if column == 0 else "")
    for axes in panels.flat:
        axes.set_yscale("log")
    panels[0, 0].set_ylim(1e-6, 1e1)
    panels[1, 0].set_ylim(1e-17, 1e0)
    for axes in panels[:, 0]:
        plain_ticks(axes.yaxis)
    legend_below(figure, panels[0, 0])
    return figure


def _of_the_living(values: np.ndarray, gone: np.ndarray) -> np.ndarray:
    """The values of motions that have not diverged; where fewer than half are left, of none."""
    few = gone.mean(axis=0) > 0.5
    left = np.where(gone, np.nan, values)
    filled = np.where(gone, np.nanmedian(np.where(few, 0.0, left), axis=0), left)
    return np.where(few, np.nan, filled)


def _draw_motions(axes: Axes, time: np.ndarray, values: np.ndarray, model: str) -> None:
    """Median over the motions, and the range from the 10th to the 90th percentile."""
    low, middle, high = np.quantile(np.maximum(values, 1e-18), (0.1, 0.5, 0.9), axis=0, method="nearest")
    high, middle = np.where(np.isinf(high), 1e3, high), np.where(np.isinf(middle), np.nan, middle)
    axes.fill_between(time, low, high, color=COLORS[model], alpha=0.12, linewidth=0)
    axes.plot(time, middle, color=COLORS[model], linewidth=1.2, label=MODELS[model].label)
