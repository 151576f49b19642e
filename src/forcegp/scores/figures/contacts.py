"""Plot: how far from free motion a recording is, and the torques of what touched the robot."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from forcegp.scores.figures import style


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
