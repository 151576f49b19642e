"""Plots: the path of the tool with the error along it, and one picture of a model."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.evaluation.plots import style
from forcegp.evaluation.plots.style import KNOWN_PHYSICS, NORMAL, QUIET, SMALL, TRUTH, new_figure, quiet, speed_colors
from forcegp.evaluation.predicted_rows import PredictedRows, predict_rows
from forcegp.mechanics import MechanicalSystem, Plane
from forcegp.models.protocol import Posterior

PATH_SECONDS = 20.0
"""Length of the path that is drawn: more becomes a tangle."""


def tool_path_figure(posterior: Posterior, dataset: Dataset) -> Figure:
    """The first contact point on x, y, coloured by speed, the training points, and its distance to the surface.

    Raises InvalidInput for a system without contacts: there is no surface to show.
    """
    figure = new_figure(9.0, 4.6)
    path, height = figure.subplots(2, 1, height_ratios=(2.0, 1.0))
    _draw_tool_path(figure, path, posterior, dataset, (2.0, 4.0))
    _draw_height(height, posterior.system, dataset)
    return figure


def _draw_tool_path(
    figure: Figure,
    axes: Axes,
    posterior: Posterior,
    whole: Dataset,
    heights: tuple[float, float],
    start: float = 0.0,
) -> None:
    """The path of the test data coloured by speed (m/s) and the training points; a tall one in a tall row.

    Drawn are at most PATH_SECONDS of the recording, from `start` seconds on; `heights` are the least and the most of
    the row, the first one, in parts of the row heights.
    """
    order, elapsed = _elapsed(whole)
    chosen = order[(elapsed >= start) & (elapsed <= start + PATH_SECONDS)]
    if not chosen.size:
        raise InvalidInput(f"no rows from {start} s on: the recording lasts {elapsed.max(initial=0.0):.3g} s.")
    dataset = whole.rows(chosen)
    position, speed, _ = tool_motion(posterior.system, dataset.q, dataset.v)
    segments = np.stack([position[:-1, :2], position[1:, :2]], axis=1)
    pauses = np.diff(dataset.time)
    usual = np.median(pauses[pauses > 0]) if (pauses > 0).any() else 0.0
    joined = (np.diff(dataset.episode) == 0) & (pauses > 0) & (pauses < 3.0 * usual)  # no line across gaps
    lines = LineCollection(list(segments[joined]), cmap=speed_colors(), linewidths=1.3, capstyle="round")
    lines.set_array(speed[:-1][joined])
    axes.add_collection(lines)
    axes.plot([], [], color=speed_colors()(0.55), linewidth=1.3, label="test: path of the tool")
    training = posterior.training
    points, _, _ = tool_motion(posterior.system, training.q.cpu().numpy(), training.v.cpu().numpy())
    dots = {"color": "white", "markersize": 4.0, "markeredgecolor": TRUTH, "markeredgewidth": 0.9}
    axes.plot(points[:, 0], points[:, 1], "o", label=f"training: {len(points)} points", **dots)
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")  # wider limits fill the panel; "box" would shrink it to a stamp
    grid = axes.get_gridspec()
    assert grid is not None  # the axes come from subplots
    rows = [heights[0], *list(grid.get_height_ratios())[1:]]  # type: ignore[arg-type]  # the stub omits that ratios are a sequence
    inch = figure.get_figheight() / sum(rows)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    wanted = 0.8 * figure.get_figwidth() * (high - low) / (right - left) / inch
    rows[0] = float(np.clip(wanted, *heights))
    grid.set_height_ratios(rows)
    figure.set_figheight(inch * sum(rows))
    quiet(axes, x="x [m]", y="y [m]")
    surface = posterior.system.contacts[0].surface
    level = isinstance(surface, Plane) and bool(np.hypot(*surface.normal[:2]) < 1e-6)
    side = "seen from above" if level else "projected on x, y"
    title = f"Tool on the surface, {side}{_excerpt(dataset, whole, before=': ')}"
    axes.set_title(title, fontsize=NORMAL, loc="left", color=TRUTH, pad=20.0)  # a row of its own above the legend
    bar = figure.colorbar(lines, ax=axes, pad=0.01, aspect=12)
    bar.set_label("speed [m/s]", fontsize=SMALL, color=QUIET)
    bar.ax.tick_params(labelsize=SMALL, labelcolor=QUIET)
    bar.outline.set_visible(False)  # type: ignore[operator]  # the stubs call it a spine with another signature
    close = {"bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.1, "borderpad": 0.2}
    axes.legend(loc="lower left", ncols=2, fontsize=SMALL, frameon=False, **close)


def _excerpt(part: Dataset, whole: Dataset, *, before: str = "", after: str = "") -> str:
    """`20 s of 100 s` between the given texts if the part is shorter than the whole, nothing otherwise."""
    shown, recorded = (_elapsed(dataset)[1].max(initial=0.0) for dataset in (part, whole))
    texts = [f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.2g} s" for seconds in (shown, recorded)]
    return "" if texts[0] == texts[1] else f"{before}{texts[0]} of {texts[1]}{after}"


def _elapsed(dataset: Dataset) -> tuple[Int[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
    """The order of the rows by episode and time, and in it the recorded seconds, one episode after the other."""
    order = np.lexsort((dataset.time, dataset.episode))
    steps = np.diff(dataset.time[order], prepend=dataset.time[order[:1]])
    steps[1:][np.diff(dataset.episode[order]) != 0] = 0.0
    return order, np.cumsum(steps)


def tool_motion(
    system: MechanicalSystem, q: Float[np.ndarray, "rows nv"], v: Float[np.ndarray, "rows nv"]
) -> tuple[Float[np.ndarray, "rows 3"], Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
    """Position (m), speed (m/s) and distance from the surface (m) of the first contact point.

    Raises InvalidInput for a system without contacts.
    """
    if not system.contacts:
        raise InvalidInput(f"{system.robot.name} touches nothing, so there is no tool path to show; give a contact.")
    contact = system.contacts[0]
    kinematics = system.robot.kinematics(torch.tensor(q), torch.tensor(v))
    jacobian = kinematics.frame_jacobian(contact.frame, contact.point)[..., :3, :]
    velocity = (jacobian @ torch.tensor(v)[..., None])[..., 0]
    return (
        contact.position(kinematics).numpy(),
        torch.linalg.vector_norm(velocity, dim=-1).numpy(),
        contact.distance(kinematics).numpy(),
    )


def _draw_height(axes: Axes, system: MechanicalSystem, dataset: Dataset) -> None:
    _, _, distance = tool_motion(system, dataset.q, dataset.v)
    largest = float(np.abs(distance).max())
    factor, unit = (1e6, "µm") if largest < 1e-3 else (1e3, "mm")
    for episode in dataset.episodes:
        rows = dataset.episode == episode
        order = np.argsort(dataset.time[rows], kind="stable")
        axes.plot(dataset.time[rows][order], factor * distance[rows][order], color=QUIET, linewidth=0.8)
    axes.margins(x=0)
    quiet(axes, title="Distance of the tool from the surface", x="time [s]", y=f"distance [{unit}]")


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
    _draw_tool_path(figure, top, posterior, dataset, (1.4, 2.0), start)
    names = style.short_joint_names(rows.joint_names)
    units = {quantity: style.joint_units(rows, quantity) for quantity in ("a", "u")}
    for column, joint in enumerate(joints):
        above = figure.add_subplot(grid[1, column])
        below = figure.add_subplot(grid[2, column], sharex=above)
        _draw_acceleration(above, rows, predicted, joint)
        _draw_force(below, rows, predicted, joint)
        style.quiet(above, title=names[joint], y="" if column else f"acceleration [{units['a'][joint]}]")
        style.quiet(below, x="time [s]", y="" if column else f"unknown force [{units['u'][joint]}]")
        above.tick_params(labelbottom=False)
    figure.align_ylabels()
    style.legend_below(figure, *figure.axes[-2:], size=style.NORMAL, markerscale=4)
    shown = _excerpt(rows, dataset, before=" (time panels: ", after=")")
    style.heading(figure, f"Prediction after {len(posterior.training)} training points{shown}", size=style.LARGE + 1)
    return figure


def _draw_acceleration(axes: Axes, rows: Dataset, predicted: PredictedRows, joint: int) -> None:
    axes.plot(rows.time, rows.a[:, joint], ".", color=style.MEASUREMENT, markersize=2.0, label="measured")
    style.draw_line(axes, rows.time, predicted.known_physics[:, joint], KNOWN_PHYSICS, 1.1, "known physics alone")
    mean, spread = predicted.mean[:, joint], 2.0 * predicted.measurement_std[:, joint]
    style.draw_band(axes, rows.time, mean, spread, alpha=0.3, label="2σ")
    style.draw_line(axes, rows.time, mean, style.PREDICTION, 1.3, "with the learned force")
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
