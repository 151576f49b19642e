"""Plot: how the objective of the fit fell, iteration by iteration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from forcegp.errors import InvalidInput
from forcegp.evaluation.plots.style import NORMAL, SERIES, SMALL, new_figure, quiet


def likelihood_figure(
    histories: Mapping[str, Sequence[float]], *, objective: str = "negative log likelihood with hyperpriors [nats]"
) -> Figure:
    """One curve per model, `{name: posterior.result.history}`; the last value of each is written beside it.

    `objective` names the values, with their unit in brackets: `posterior.objective`.
    Raises InvalidInput without any history.
    """
    if not histories or not all(len(history) for history in histories.values()):
        raise InvalidInput("no history to plot; give {name: posterior.result.history}.")
    figure = new_figure(7.0, 3.6)
    axes = figure.subplots()
    for color, (name, history) in zip(SERIES, histories.items(), strict=False):
        last = len(history) - 1
        axes.plot(history, color=color, linewidth=1.6, label=name)
        axes.plot(last, history[-1], "o", color=color, markersize=4)
        axes.annotate(
            f"{history[-1]:.1f}" if abs(history[-1]) >= 10.0 else f"{history[-1]:.3g}",
            (last, history[-1]),
            xytext=(6, 0),
            textcoords="offset points",
            color=color,
            fontsize=SMALL,
            va="center",
        )
    axes.margins(x=0.08)
    what, _, unit = objective.partition(" [")
    quiet(axes, title=f"What the search lowers: {what}", x="iteration", y=unit.removesuffix("]"))
    axes.legend(fontsize=NORMAL, frameon=False)
    return figure
