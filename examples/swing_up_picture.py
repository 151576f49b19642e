"""The picture of swing_up.py: planned joint angles, true ones under the planned torques, and these torques."""

import matplotlib.pyplot as plt
import numpy as np
from two_links import DT, LIMIT, ROBOT, UPRIGHT

COLORS = "#E69F00", "#CC79A7"  # of the joints


def picture(plans, path="swing-up.png"):
    """Write it; `plans` holds torques, planned and true states by title."""
    steps, names = len(next(iter(plans.values()))[0]), ROBOT.joint_names
    time = DT * np.arange(steps + 1)
    figure, axes = plt.subplots(3, len(plans), figsize=(10, 8), sharex=True, sharey="row", layout="constrained")
    for column, (title, (u, states, true)) in zip(axes.T, plans.items(), strict=True):
        for joint, axis in enumerate(column[:2]):
            axis.plot(time, true[:, joint], color="0.7", linewidth=4, label="true arm under the planned torques")
            axis.plot(time, states[:, joint], "--", color="#0072B2", label="planned")
            axis.axhline(UPRIGHT[joint], color="0.8", linewidth=0.8, zorder=0)
            axis.set_ylabel(f"{names[joint]} [rad]")
        for joint, name in enumerate(names):
            column[2].stairs(u[:, joint], time, baseline=None, color=COLORS[joint], label=name)
        for limit in (-LIMIT, LIMIT):
            column[2].axhline(limit, color="0.8", linewidth=0.8, zorder=0)
        column[2].set_ylabel("torque [Nm]")
        column[2].set_xlabel("time [s]")
        column[0].set_title(title)
    for axis in axes[[0, 2], 0]:
        axis.legend(loc="best", fontsize="small")
    figure.savefig(path, dpi=110)
    plt.close(figure)
