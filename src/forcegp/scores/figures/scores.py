"""Figures of scores: errors per joint, and errors of predicted motions against their length."""

import re
from typing import Any

from matplotlib.figure import Figure

from forcegp.scores.accuracy import ACCELERATION, FORCE
from forcegp.scores.figures import style
from forcegp.scores.page import unit_of
from forcegp.scores.scores import Scores
from forcegp.scores.tables import median_and_range

COLORS = {
    "given": (style.KNOWN_PHYSICS,),
    "identified": (style.IDENTIFIED, "#00563F"),
    "black box": (style.BLACK_BOX, "#7B3F67"),
    "residual": (style.SERIES[4],),
    "force prior": (style.PREDICTION, style.SERIES[5], "#17375E"),
}
"""By the kind of a model, as in all other figures; what is refined on motions is its model with dashes."""
MOST_COLUMNS = 7
"""Panels beside each other that a page still shows large enough to read."""


def scores_pictures(scores: Scores) -> list[style.Picture]:
    """Those for which there are numbers."""
    models = [name for name in scores.models if ACCELERATION in scores.quantities(name)]
    if not models:
        return []
    moved, errors = "How the error of predicted positions grows, on time that no model has seen.", "Errors by joint."
    found = [style.Picture("motions", moved, motions_figure(scores, models))] if scores.horizons else []
    return [*found, style.Picture("errors", errors, errors_figure(scores, models))]


def errors_figure(scores: Scores, models: list[str]) -> Figure:
    """One row per model, one panel per joint: normalised errors of accelerations above, force errors below.

    Many joints take several lines of at most `MOST_COLUMNS` panels. A dot is the median over runs, the line behind it
    the range.
    """
    joints, looks = style.short_joint_names(scores.joint_names), _looks(scores, models)
    parts = [
        (ACCELERATION, "nrmse", "Acceleration: RMSE / standard deviation of the measurement"),
        (FORCE, "rmse", f"Force: RMS of M (predicted − measured acceleration) [{unit_of(scores, 'u')}]"),
    ]
    lines = -(-len(joints) // MOST_COLUMNS)
    columns = -(-len(joints) // lines)
    figure = style.new_figure(2.4 + max(4.2, 1.35 * columns), 0.5 + lines * (0.9 + 0.44 * len(models)))
    halves: Any = figure.subfigures(2, 1)
    for part, (quantity, score, title) in zip(halves, parts, strict=True):
        panels = part.subplots(lines, columns, sharey=True, squeeze=False)
        style.heading(part, title, size=style.NORMAL)
        for axes in panels.flat[len(joints) :]:
            axes.set_visible(False)
        for joint, axes in enumerate(panels.flat[: len(joints)]):
            for row, name in enumerate(models):
                runs = [run["table"][quantity][score][joint] for run in scores.finished(name)]
                value, color = median_and_range(runs), looks[name]["color"]
                if value is not None:
                    inside = looks[name]["markerfacecolor"]
                    axes.plot([value["min"], value["max"]], [row, row], color=color, linewidth=4.0, alpha=0.35)
                    axes.plot(value["median"], row, "o", markersize=5.5, color=color, markerfacecolor=inside)
            style.quiet(axes, title=joints[joint])
            axes.set_xscale("log")
            axes.margins(x=0.12)
            style.plain_ticks(axes.xaxis)
        panels[0, 0].set_yticks(range(len(models)), models)
        panels[0, 0].set_ylim(len(models) - 0.5, -0.5)
    return figure


def motions_figure(scores: Scores, models: list[str]) -> Figure:
    """RMS error of q over motions and joints against the length of the prediction: median and range over runs."""
    figure = style.new_figure(8.2, 3.8)
    axes = figure.subplots()
    for name, looks in _looks(scores, models).items():
        spreads = {h: scores.spread("rmse", f"position after {h:g} s", name) for h in scores.horizons}
        known = {h: spread for h, spread in spreads.items() if spread is not None}
        low, middle, high = ([spread[key] for spread in known.values()] for key in ("min", "median", "max"))
        axes.plot(list(known), middle, label=name, **looks)
        axes.fill_between(list(known), low, high, color=looks["color"], alpha=0.12, linewidth=0)
    title, label = "Motions predicted from recorded states under recorded forces", unit_of(scores, "q")
    style.quiet(axes, title=title, x="length of the prediction [s]", y=f"RMS error of q [{label}]")
    axes.set_yscale("log")
    style.plain_ticks(axes.yaxis)
    figure.legend(loc="outside right upper", fontsize=style.SMALL, frameon=False)
    return figure


def _looks(scores: Scores, models: list[str]) -> dict[str, dict[str, Any]]:
    """How every model is drawn: colours of its kind; earlier ones wider, so that curves which coincide are seen."""
    bases = {name: re.sub(r"[@+]motions(:[^+]*)?$", "", name) for name in models}  # without refinement on motions
    kinds = {base: scores.models[name]["kind"] for name, base in bases.items()}
    named = sorted(kinds, key=lambda base: "gp:joint-friction" not in base)  # which has one colour everywhere
    looks = {}
    for below, (name, base) in enumerate(bases.items(), start=1 - len(models)):
        alike = [other for other in named if kinds[other] == kinds[base]]
        turn, place = divmod(alike.index(base), len(COLORS[kinds[base]]))
        color, refined = COLORS[kinds[base]][place], name != base
        looks[name] = {"color": color, "linestyle": "--" if refined else ("-", "-.", ":")[turn % 3]}
        looks[name] |= {"linewidth": 1.2 - 0.35 * below, "marker": "o", "markersize": 3.0 - 0.5 * below}
        looks[name] |= {"markerfacecolor": "white" if refined else color}
    return looks
