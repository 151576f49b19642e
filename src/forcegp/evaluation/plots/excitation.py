"""Plot: what a chosen motion will visit, against the log so far, and how sure friction curves will be after it."""

import numpy as np
from matplotlib.figure import Figure

from forcegp.control.informative_motions import Excitation
from forcegp.evaluation.plots import style
from forcegp.evaluation.plots.friction_curves import curve_panels


def excitation_figure(chosen: Excitation) -> Figure:
    """Velocity over position of every joint; below, where each has one friction curve, this before and after."""
    robot, model, fastest = chosen.robot, chosen.model, chosen.limits["velocity"][1]
    panels = [] if model is None else curve_panels(model)
    rows = 2 if len(panels) == robot.nv else 1
    figure = style.new_figure(max(2.2 * robot.nv, 6.0), 1.2 + 2.2 * rows)
    grid = figure.subplots(rows, robot.nv, squeeze=False)
    for j, name in enumerate(style.short_joint_names(robot.joint_names)):
        axes = grid[0, j]
        if model is not None:
            log = model.training.q[:, j], model.training.v[:, j]
            axes.plot(*log, ".", markersize=3, color=style.KNOWN_PHYSICS, label="log so far", zorder=3)
        style.draw_line(axes, chosen.motion.q[:, j], chosen.motion.v[:, j], style.PREDICTION, 1.0, "chosen motion")
        style.quiet(axes, title=name, x="position in rad (m)", y="" if j else "velocity in rad/s (m/s)")
        if model is None or chosen.expected is None or rows == 1:
            continue
        axes, v = grid[1, j], np.linspace(-fastest[j], fastest[j], 301)
        for posterior, color, when in (
            (model, style.KNOWN_PHYSICS, "so far"),
            (chosen.expected, style.PREDICTION, "after"),
        ):
            std = posterior.curve(panels[j].latent, v).std
            style.draw_line(axes, v, std, color, 1.2, f"standard deviation {when}")
        axes.set_yscale("log")
        style.quiet(axes, x="velocity in rad/s (m/s)", y="" if j else "standard deviation in Nm (N)")
    style.legend_below(figure, *grid[:, 0])
    style.heading(figure, f"The next {chosen.seconds:g} s")
    return figure
