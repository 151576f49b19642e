"""Plot: predicted and recorded motion joint by joint, how the error grows, and how far the tool is off the surface."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from forcegp.data import Dataset
from forcegp.data.configurations import space_of
from forcegp.data.motion_records import RecordedMotions
from forcegp.evaluation.plots import style
from forcegp.evaluation.rollout_scores import INTERVAL, RolloutErrors, apart_from, interval_about
from forcegp.posterior.rollout import Rollout

COLUMNS = 4
SMALLEST_SHOWN = 1e-16
"""Distances below this are drawn here: the logarithm of zero cannot be."""


def rollout_figure(
    rollout: Rollout, recorded: RecordedMotions, errors: RolloutErrors, dataset: Dataset, title: str
) -> Figure:
    """The first motion joint by joint, with the 95 % interval of the samples; below, the errors of all motions."""
    nv, space = len(dataset.joint_names), space_of(dataset)
    # a base that moves is drawn by its way from where it began
    origin = torch.zeros_like(rollout.q[0]) if space.is_vector_space else rollout.q[0, :1].expand_as(rollout.q[0])
    mean = apart_from(origin, rollout.q[0], space).cpu().numpy()
    actual = apart_from(origin, torch.as_tensor(np.array(recorded.q[0]), device=origin.device), space).cpu().numpy()
    grid_rows = -(-nv // COLUMNS)
    figure = style.new_figure(11.0, 1.9 * grid_rows + 3.9)
    halves: Any = figure.subfigures(2, 1, height_ratios=(1.9 * grid_rows + 0.6, 3.3))
    above, below = halves
    axes = style.joint_panels(above, nv, COLUMNS)
    names, units = style.short_joint_names(dataset.joint_names), style.joint_units(dataset, "q")
    band, label = None, ""
    if errors.spread is not None:
        whole = torch.zeros_like(rollout.q) if space.is_vector_space else rollout.q[:, :1].expand_as(rollout.q)
        band = np.stack([end.cpu().numpy()[0] for end in interval_about(rollout, whole, space)])
        label = "95 % interval" if rollout.samples is None else f"95 % of {len(rollout.samples.q)} samples"
        label = label if rollout.intervals is None else "95 % interval, calibrated"
    for joint, (panel, lowest) in enumerate(axes):
        if band is not None:
            low, high = band[..., joint]
            panel.fill_between(errors.time, low, high, color=style.PREDICTION, alpha=0.25, linewidth=0, label=label)
        style.draw_line(panel, errors.time, actual[:, joint], style.TRUTH, 1.4, "recorded")
        dashed = {"label": "rollout of the mean", "linestyle": style.DASHED}
        style.draw_line(panel, errors.time, mean[:, joint], style.PREDICTION, 1.4, **dashed)
        panel.margins(x=0)
        style.quiet(panel, title=names[joint], y=units[joint], x="time [s]" if lowest else "")
    style.legend_above(above, f"{title}; from row {recorded.rows[0]}", axes[0][0])
    panels = [(_draw_joint_error, True), (_draw_tool, errors.tool is not None)]
    panels.append((_draw_constraint, errors.constraint is not None))
    drawn = [draw for draw, shown in panels if shown]
    for draw, panel in zip(drawn, below.subplots(1, len(drawn), squeeze=False)[0], strict=True):
        draw(panel, rollout, errors)
    below.axes[0].set_ylabel(" or ".join(dict.fromkeys(units)))
    return figure


def _draw_joint_error(axes: Axes, rollout: Rollout, errors: RolloutErrors) -> None:
    largest = errors.joint.max(-1)
    _draw_all(axes, errors.time, largest)
    if errors.spread is not None:
        expected = _median(errors.spread.max(-1))[1:]
        style.draw_line(axes, errors.time[1:], expected, style.TRUTH, 1.2, "half the 95 % interval", linestyle=":")
    count, ended = len(errors.diverged_at), int((errors.diverged_at >= 0).sum())
    motions = ("1 motion" if count == 1 else f"{count} motions") + (f", {ended} diverged" if ended else "")
    _finish(axes, f"Largest joint error, {motions}", "")


def _draw_tool(axes: Axes, rollout: Rollout, errors: RolloutErrors) -> None:
    assert errors.tool is not None
    _draw_all(axes, errors.time, errors.tool)
    _finish(axes, "Distance of the tool from the recorded one", "m")


def _draw_constraint(axes: Axes, rollout: Rollout, errors: RolloutErrors) -> None:
    assert errors.constraint is not None
    assert errors.recorded_constraint is not None
    if rollout.samples is not None:
        sampled = rollout.samples.constraint.abs().amax(-1).flatten(0, 1).cpu().numpy()
        lasting = sampled[np.isfinite(sampled).all(-1)]
        if len(lasting):
            low, high = np.maximum(np.quantile(lasting, INTERVAL, axis=0), SMALLEST_SHOWN)
            middle, half = 0.5 * (high + low), 0.5 * (high - low)
            style.draw_band(axes, errors.time, middle, half, alpha=0.13, label="95 % of samples")
    _draw_all(axes, errors.time, np.maximum(errors.constraint, SMALLEST_SHOWN), first=0)
    recorded = np.maximum(np.median(errors.recorded_constraint, axis=0), SMALLEST_SHOWN)
    style.draw_line(axes, errors.time, recorded, style.TRUTH, 1.2, "recorded, median", linestyle=(0, (1, 1.5)))
    _finish(axes, "Distance of the tool from the surface |c|", "m")
    shown = np.fmin(recorded, np.where(np.isfinite(errors.constraint), errors.constraint, np.inf).max(0))
    axes.set_ylim(bottom=max(SMALLEST_SHOWN, 1e-2 * float(shown.min())))  # where c changes sign, |c| falls without end


def _draw_all(
    axes: Axes, time: Float[np.ndarray, " rows"], values: Float[np.ndarray, "motions rows"], first: int = 1
) -> None:
    """Thin lines for all motions and a thick one for their median, where any is left; row 0 of an error is 0."""
    if len(values) > 1:
        axes.plot(time[first:], values[:, first:].T, color=style.PREDICTION, linewidth=0.6, alpha=0.35)
    median = _median(values)
    label = "median" if len(values) > 1 else "rollout"
    axes.plot(time[first:], median[first:], color=style.PREDICTION, linewidth=1.8, label=label)


def _median(values: Float[np.ndarray, "motions rows"]) -> Float[np.ndarray, " rows"]:
    """Over all motions, where those that diverged are the farthest; NaN where it is one of these."""
    median = np.median(np.where(np.isfinite(values), values, np.inf), axis=0)
    return np.where(np.isfinite(median), median, np.nan)


def _finish(axes: Axes, title: str, unit: str) -> None:
    axes.set_yscale("log")
    axes.margins(x=0)
    style.quiet(axes, title=title, x="time [s]", y=unit)
    axes.legend(fontsize=style.SMALL, frameon=False, loc="lower right")
