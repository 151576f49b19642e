"""Plot: errors against training points, with the published curves drawn in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from forcegp.evaluation.plots.style import QUIET, SERIES, legend_below, new_figure, quiet
from forcegp.experiments import published
from forcegp.experiments.model_names import MODELS

COLORS = dict(
    zip(MODELS, (SERIES[1], SERIES[4], SERIES[2], SERIES[0], SERIES[6], QUIET, SERIES[3], SERIES[5]), strict=True)
)
"""One colour per model, the same in every figure."""

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
        for model, curve in summary["curves"].items():
            _draw_ours(axes, curve, score, model)
        _draw_published(axes, summary, score)
        axes.set(xscale="log", yscale="log")
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.xaxis.set_minor_formatter(NullFormatter())
        if score != "constraint_error":
            axes.yaxis.set_major_formatter(ScalarFormatter())
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_minor_formatter(NullFormatter())
        quiet(axes, title=heading, x="training points N", y="")
    panels[0].axhline(summary["noise_floor"], color=QUIET, linewidth=0.8)
    panels[0].annotate(
        "noise floor", (counts[0], summary["noise_floor"]), (0, -9), textcoords="offset points", fontsize=7, color=QUIET
    )
    panels[0].plot([], [], color=QUIET, linestyle="--", linewidth=1.0, label="published (2021)")
    legend_below(figure, panels[0], columns=5)
    return figure


def _draw_ours(axes: Axes, curve: Mapping[str, Any], score: str, model: str) -> None:
    counts = [int(count) for count in curve]
    values = {part: [scores[score][part] for scores in curve.values()] for part in ("median", "min", "max")}
    color = COLORS[model]
    axes.fill_between(counts, values["min"], values["max"], color=color, alpha=0.15, linewidth=0)
    axes.plot(counts, values["median"], color=color, marker="o", markersize=3.5, label=MODELS[model].label)


def _draw_published(axes: Axes, summary: Mapping[str, Any], score: str) -> None:
    curves = {"mae": published.FIG2B_MAE, "constraint_error": published.FIG2B_CONSTRAINT_ERROR}.get(score, {})
    for model, values in curves.items():
        if model in summary["curves"]:
            axes.plot(published.FIG2B_POINTS, values, color=COLORS[model], linestyle="--", linewidth=1.0, alpha=0.8)
