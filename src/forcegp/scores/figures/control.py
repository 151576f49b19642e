"""Plots of the monitor and of the next motion: what touched a robot, and what a chosen motion will teach."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from forcegp.control.informative_motions import Excitation
from forcegp.scores.figures import style
from forcegp.scores.figures.friction_curves import curve_panels


def contacts_figure(
    time: Float[np.ndarray, " rows"],
    distance: Float[np.ndarray, " rows"],
    threshold: float,
    torque: Float[np.ndarray, "rows nv"],
    contacts: Sequence[tuple[float, float]],
    joints: Sequence[str],
    title: str,
) -> Figure:
    """Squared Mahalanobis distances with their threshold, and torques in Nm (N); `contacts` (start, end) in s."""
    figure = style.new_figure(9.0, 5.4)
    above, below = figure.subplots(2, 1, sharex=True)
    for axes in (above, below):
        axes.margins(x=0)
        for start, end in contacts:
            axes.axvspan(start, end, color=style.KNOWN_PHYSICS, alpha=0.18, linewidth=0, label="contact")
    style.draw_line(above, time, np.maximum(distance, 1e-3), style.PREDICTION, 0.8, "distance from free motion")
    style.draw_line(above, time, np.full_like(time, threshold), style.TRUTH, 1.0, "threshold", linestyle=style.DASHED)
    above.set_yscale("log")
    above.set_ylim(bottom=max(0.1, float(np.quantile(distance, 0.01))))
    style.quiet(above, y="squared distance [σ²]")
    names = style.short_joint_names(joints)
    for joint, name in enumerate(names):
        style.draw_line(below, time, torque[:, joint], style.SERIES[joint % len(style.SERIES)], 0.9, name)
    style.quiet(below, x="time [s]", y="unexplained torque [Nm (N)]")
    style.legend_above(figure, title, above)
    style.legend_below(figure, below)
    return figure


def excitation_figure(chosen: Excitation) -> Figure:
    """Velocity over position of every joint; below, where each has one friction curve, this before and after."""
    robot, model, fastest = chosen.robot, chosen.model, chosen.limits["velocity"][1]
    panels = [] if model is None else curve_panels(model)
    rows = 2 if len(panels) == robot.nv else 1
    figure = style.new_figure(max(2.2 * robot.nv, 6.0), 1.2 + 2.2 * rows)
    grid = figure.subplots(rows, robot.nv, squeeze=False)
    for j, name in enumerate(style.short_joint_names(robot.joint_names)):
        axes, (length, force) = grid[0, j], ("m", "N") if robot.joints[j].type == "prismatic" else ("rad", "Nm")
        if model is not None:
            log = model.training.q[:, j], model.training.v[:, j]
            axes.plot(*log, ".", markersize=3, color=style.QUIET, label="log so far", zorder=3)
        style.draw_line(axes, chosen.motion.q[:, j], chosen.motion.v[:, j], style.PREDICTION, 1.0, "chosen motion")
        axes.locator_params(nbins=4)
        style.quiet(axes, title=name, x=f"position [{length}]", y="" if j else f"velocity [{length}/s]")
        if model is None or chosen.expected is None or rows == 1:
            continue
        axes, v = grid[1, j], np.linspace(-fastest[j], fastest[j], 301)
        for posterior, color, when in ((model, style.QUIET, "so far"), (chosen.expected, style.PREDICTION, "after")):
            std = posterior.curve(panels[j].latent, v).std
            style.draw_line(axes, v, std, color, 1.2, f"standard deviation {when}")
        axes.set_yscale("log")
        style.quiet(axes, x=f"velocity [{length}/s]", y="" if j else f"standard deviation\nof friction [{force}]")
    style.legend_below(figure, *grid[:, 0])
    style.heading(figure, f"The next {chosen.seconds:g} s")
    return figure
