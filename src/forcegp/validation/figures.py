"""Figures of a comparison: errors per joint, calibration, and errors of predicted motions against their length."""

import re
from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from forcegp.evaluation.plots import style
from forcegp.validation.page import unit_of

COLORS = {
    "given": (style.KNOWN_PHYSICS,),
    "identified": (style.IDENTIFIED, "#00563F"),
    "black box": (style.BLACK_BOX, "#7B3F67"),
    "residual": (style.SERIES[4],),
    "force prior": (style.PREDICTION, style.SERIES[5], "#17375E"),
}
"""By the kind of a model, as in all other figures; what is refined on motions is its model with dashes."""


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


MOST_COLUMNS = 7
"""Panels beside each other that a page still shows large enough to read."""


def errors_figure(models: Mapping[str, Any], document: Mapping[str, Any]) -> Figure:
    """One row per model, one panel per joint: normalised errors of accelerations above, force errors below.

    Many joints take several lines of at most `MOST_COLUMNS` panels. A dot is the median over runs, the line behind it
    the range.
    """
    joints, looks = style.short_joint_names(document["joint_names"]), _looks(models)
    scores = {
        "nrmse": "Acceleration: RMSE / standard deviation of the measurement",
        "force_rms": f"Force: RMS of M (predicted − measured acceleration) [{unit_of(document, 'u')}]",
    }
    lines = -(-len(joints) // MOST_COLUMNS)
    columns = -(-len(joints) // lines)
    figure = style.new_figure(2.4 + max(4.2, 1.35 * columns), 0.5 + lines * (0.9 + 0.44 * len(models)))
    halves: Any = figure.subfigures(2, 1)
    for part, (score, title) in zip(halves, scores.items(), strict=True):
        panels = part.subplots(lines, columns, sharey=True, squeeze=False)
        style.heading(part, title, size=style.NORMAL)
        for axes in panels.flat[len(joints) :]:
            axes.set_visible(False)
        for joint, axes in enumerate(panels.flat[: len(joints)]):
            for row, (name, model) in enumerate(models.items()):
                value = model[f"{score}_per_joint"][joint]
                if value is not None:
                    color, inside = (looks[name][part] for part in ("color", "markerfacecolor"))
                    axes.plot([value["min"], value["max"]], [row, row], color=color, linewidth=4.0, alpha=0.35)
                    axes.plot(value["median"], row, "o", markersize=5.5, color=color, markerfacecolor=inside)
            style.quiet(axes, title=joints[joint])
            axes.set_xscale("log")
            axes.margins(x=0.12)
            style.plain_ticks(axes.xaxis)
        panels[0, 0].set_yticks(range(len(models)), list(models))
        panels[0, 0].set_ylim(len(models) - 0.5, -0.5)
    return figure


def calibration_figure(models: Mapping[str, Any]) -> Figure:
    """The share of held-out accelerations inside the central intervals, against the share that should be."""
    figure = style.new_figure(7.6, 4.4)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color=style.TRUTH, linewidth=1.0, label="exact")
    for name, looks in _looks(models).items():
        calibration = models[name]["calibration"]
        axes.plot(calibration["levels"], [covered["median"] for covered in calibration["covered"]], label=name, **looks)
    title = "Calibration, mean over joints, median over runs"
    style.quiet(axes, title=title, x="nominal interval", y="held-out rows inside")
    axes.set_aspect("equal")
    corner = {"fontsize": style.NORMAL, "color": style.QUIET}
    axes.text(0.98, 0.02, "intervals too narrow", ha="right", **corner)
    axes.text(0.0, 0.97, "too wide", **corner)
    figure.legend(loc="outside right upper", fontsize=style.SMALL, frameon=False)
    return figure


def motions_figure(models: Mapping[str, Any], document: Mapping[str, Any]) -> Figure:
    """RMS error of q over motions and joints against the length of the prediction: median and range over runs."""
    figure = style.new_figure(8.2, 3.8)
    axes = figure.subplots()
    for name, looks in _looks(models).items():
        motions = models[name]["motions"]
        known = [(h, rms) for h, rms in zip(motions["horizons"], motions["rms"], strict=True) if rms is not None]
        if not known:
            continue
        time = [h for h, _ in known]
        low, middle, high = ([rms[key] for _, rms in known] for key in ("min", "median", "max"))
        axes.plot(time, middle, label=name, **looks)
        axes.fill_between(time, low, high, color=looks["color"], alpha=0.12, linewidth=0)
    title, label = "Motions predicted from recorded states under recorded forces", unit_of(document, "q")
    style.quiet(axes, title=title, x="length of the prediction [s]", y=f"RMS error of q [{label}]")
    axes.set_yscale("log")
    style.plain_ticks(axes.yaxis)
    figure.legend(loc="outside right upper", fontsize=style.SMALL, frameon=False)
    return figure


def _unrefined(name: str) -> str:
    """The name of a model without its motions."""
    return re.sub(r"[@+]motions(:[^+]*)?$", "", name)


def _looks(models: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """How every model is drawn: colours of its kind; earlier ones wider, so that curves which coincide are seen."""
    kinds = {_unrefined(name): model["kind"] for name, model in models.items()}
    named = sorted(kinds, key=lambda base: "gp:joint-friction" not in base)  # which has one colour everywhere
    looks = {}
    for below, name in enumerate(models, start=1 - len(models)):
        base = _unrefined(name)
        alike = [other for other in named if kinds[other] == kinds[base]]
        turn, place = divmod(alike.index(base), len(COLORS[kinds[base]]))
        color, refined = COLORS[kinds[base]][place], name != base
        looks[name] = {"color": color, "linestyle": "--" if refined else ("-", "-.", ":")[turn % 3]}
        looks[name] |= {"linewidth": 1.2 - 0.35 * below, "marker": "o", "markersize": 3.0 - 0.5 * below}
        looks[name] |= {"markerfacecolor": "white" if refined else color}
    return looks
