"""Plot: where the tool went on the surface, how fast, how far off the surface, and where the model was trained."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float

from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.evaluation.figure_style import (
    QUIET,
    SMALL,
    TRUTH,
    new_figure,
    quiet,
    speed_colors,
)
from forcegp.mechanics import MechanicalSystem
from forcegp.models import StructuredPosterior

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure


def tool_path_figure(posterior: StructuredPosterior, dataset: Dataset) -> Figure:
    """The first contact point seen from above, coloured by speed, the training points, and its distance to the surface.

    Raises InvalidInput for a system without contacts: there is no surface to show.
    """
    figure = new_figure(9.0, 4.4)
    path, height = figure.subplots(2, 1, height_ratios=(1.9, 1.0))
    lines = draw_tool_path(path, posterior, dataset)
    finish_tool_path(figure, path, lines)
    _draw_height(height, posterior.system, dataset)
    return figure


def draw_tool_path(axes: Axes, posterior: StructuredPosterior, dataset: Dataset) -> LineCollection:
    """The path of the test data coloured by speed (m/s) and the training points on top; returns the coloured lines."""
    from matplotlib.collections import LineCollection

    position, speed, _ = tool_motion(posterior.system, dataset.q, dataset.v)
    segments = np.stack([position[:-1, :2], position[1:, :2]], axis=1)
    pauses = np.diff(dataset.time)
    usual = np.median(pauses[pauses > 0]) if (pauses > 0).any() else 0.0
    joined = (np.diff(dataset.episode) == 0) & (pauses > 0) & (pauses < 3.0 * usual)  # no line across gaps
    lines = LineCollection(list(segments[joined]), cmap=speed_colors(), linewidths=1.3, capstyle="round")
    lines.set_array(speed[:-1][joined])
    axes.add_collection(lines)
    axes.plot([], [], color=speed_colors()(0.55), linewidth=1.3, label="test: path of the tool")
    training = posterior.likelihood.training
    points, _, _ = tool_motion(posterior.system, training.q.cpu().numpy(), training.v.cpu().numpy())
    axes.plot(
        points[:, 0],
        points[:, 1],
        "o",
        color="white",
        markersize=4.0,
        markeredgecolor=TRUTH,
        markeredgewidth=0.9,
        label=f"training: {len(points)} points",
    )
    axes.set_aspect("equal")
    axes.autoscale_view()
    return lines


def finish_tool_path(figure: Figure, axes: Axes, lines: LineCollection) -> None:
    """Labels, legend and the scale of speeds."""
    quiet(axes, title="Tool on the surface, seen from above", x="x in m", y="y in m")
    bar = figure.colorbar(lines, ax=axes, pad=0.01, aspect=12)
    bar.set_label("speed in m/s", fontsize=SMALL, color=QUIET)
    bar.ax.tick_params(labelsize=SMALL, labelcolor=QUIET)
    bar.outline.set_visible(False)  # type: ignore[operator]  # the stubs call it a spine with another signature
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=SMALL, frameon=False, borderaxespad=0.2)


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
    quiet(axes, title="Distance of the tool from the surface", x="time in s", y=f"distance in {unit}")
