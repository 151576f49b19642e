"""The pictures of docs/how-to/control.md, of one seed: `tracking` as a film, and contacts.

python -m benchmarks.control_pictures
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from PIL import Image

from benchmarks.tracking import (
    CONFIG,
    GAINS,
    RATE,
    PDGravity,
    controllers,
    error,
    excitation,
    fits,
    followed,
    robot_of,
    rows_of,
    task_of,
)
from forcegp import Model, Robot
from forcegp.posterior import Posterior
from forcegp.scores.figures.style import (
    IDENTIFIED,
    KNOWN_PHYSICS,
    MEASUREMENT,
    PREDICTION,
    QUANTILE,
    SMALL,
    TRUTH,
    draw_band,
    legend_below,
    new_figure,
    quiet,
)
from forcegp.simulation.kuka_surface import joint_friction_of

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "how-to" / "control"
SEED, SECONDS, FRAMES_PER_SECOND = 1, 10.0, 12
SHOWN = ("URDF", "learned")
COLORS = {
    "PD + gravity": MEASUREMENT,
    "URDF": KNOWN_PHYSICS,
    "Coulomb's and viscous friction": IDENTIFIED,
    "learned": PREDICTION,
    "true model": TRUTH,
}


def motions() -> tuple[Robot, Posterior, dict[str, dict[str, np.ndarray]]]:
    """The arm, the model that learned, and controller -> what the arm did."""
    robot = robot_of()
    given, task = Model(robot), task_of(SEED)
    rows = rows_of(followed(robot, excitation(SEED), PDGravity(robot, **GAINS), 20.0), given, SEED)
    found = controllers(rows, given, robot, SEED)
    done = {name: followed(robot, task, control, SECONDS) for name, control in found.items()}
    return robot, fits(rows, given, SEED)["learned"], done


def links(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Origins of the links (n, links, 3) in m."""
    kinematics = robot.kinematics(torch.tensor(q))
    names = [joint.child for joint in robot.joints]
    return torch.stack([kinematics.frame_pose(name)[..., :3, 3] for name in names], dim=1).numpy()


CURVES = (0, 1, 3)  # joints whose friction is drawn beside the arms: those with the largest
ARROW = 0.06  # metres that stand for 1 Nm of learned friction, along the axis of its joint
PALETTE, PIXELS = 64, 100


def film(robot: Robot, model: Posterior, done: dict[str, dict[str, np.ndarray]]) -> list[Image.Image]:
    """The arm under two controllers, the reference in grey; learned friction as arrows, and as curves with bands."""
    figure = new_figure(7.6, 4.5)
    halves: Any = figure.subfigures(2, 1, height_ratios=(1.7, 1.0))
    arms, below = halves
    every = slice(None, None, RATE // FRAMES_PER_SECOND)
    moving: list[Callable[[int], None]] = []
    axes: Any = None
    for place, name in enumerate(SHOWN):
        axes = arms.add_subplot(1, 2, place + 1, projection="3d")
        moving += draw_arm(axes, robot, done[name], name, every)
    learned = done["learned"]
    friction = model.predict(*(torch.tensor(learned[x][every]) for x in "qvu")).unknown_force
    assert friction is not None, "models of joint friction predict it"
    force = friction.mean.numpy()
    moving += draw_arrows(axes, robot, learned["q"][every], force)
    for axes, joint in zip(below.subplots(1, len(CURVES)), CURVES, strict=True):
        moving.append(draw_friction(axes, robot, model, joint, learned["v"][every, joint]))
    legend_below(below, axes)
    frames = []
    for frame in range(len(force)):
        for move in moving:
            move(frame)
        canvas: Any = figure.canvas
        canvas.draw()
        shown = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
        width, height = (round(size * PIXELS) for size in figure.get_size_inches())
        frames.append(shown.resize((width, height), Image.Resampling.LANCZOS))
    palette = frames[len(frames) // 2].quantize(PALETTE, Image.Quantize.MAXCOVERAGE, kmeans=3)
    return [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]


def draw_arm(
    axes: Any, robot: Robot, motion: dict[str, np.ndarray], name: str, every: slice
) -> list[Callable[[int], None]]:
    """The arm above its reference, each with the trace of its tool; returns what moves them."""
    arm, wanted = (links(robot, q[every]) for q in (motion["q"], motion["q"] + motion["e"]))
    drawn = {}
    for values, color, width in ((wanted, "0.75", 6.0), (arm, COLORS[name], 2.5)):
        (line,) = axes.plot(*values[0].T, "o-", color=color, linewidth=width, markersize=0.8 * width)
        (trace,) = axes.plot(*values[:1, -1].T, color=color, linewidth=0.4 * width)
        drawn[line, trace] = values
    both = np.concatenate([arm, wanted]).reshape(-1, 3)
    low, high = both.min(0), both.max(0)
    axes.set_box_aspect(high - low, zoom=1.5)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_axis_off()
    axes.view_init(elev=18, azim=-60)
    axes.set_title(f"computed torque, {name}: {error(motion):.3g} mrad", fontsize=SMALL, color=TRUTH, y=0.97)

    def move(frame: int) -> None:
        for (line, trace), values in drawn.items():
            line.set_data_3d(*values[frame].T)
            trace.set_data_3d(*values[max(0, frame - 20) : frame + 1, -1].T)

    return [move]


def draw_arrows(axes: Any, robot: Robot, q: np.ndarray, force: np.ndarray) -> list[Callable[[int], None]]:
    """The learned torque of every joint as a line along its axis, from the place of the joint."""
    kinematics = robot.kinematics(torch.tensor(q))
    moving = []
    for j, joint in enumerate(robot.joints):
        pose = kinematics.frame_pose(joint.child).numpy()
        along = pose[:, :3, :3] @ np.asarray(joint.axis)
        ends = np.stack([pose[:, :3, 3], pose[:, :3, 3] + ARROW * force[:, j, None] * along], axis=1)
        (line,) = axes.plot(*ends[0].T, color=IDENTIFIED, linewidth=3.0, solid_capstyle="butt", zorder=10)
        moving.append(lambda frame, line=line, ends=ends: line.set_data_3d(*ends[frame].T))
    return moving


def draw_friction(
    axes: Axes, robot: Robot, model: Posterior, joint: int, velocity: np.ndarray
) -> Callable[[int], None]:
    """The learned friction of a joint over its velocity with its 95 % interval, and a dot where the joint is now."""
    name = robot.joint_names[joint]
    seen = model.training.v[:, joint].abs().max().item()
    v = np.linspace(-1.3, 1.3, 241) * seen  # beyond what was seen, where intervals widen
    curve, now = model.curve(name, v), model.curve(name, velocity).mean.numpy()
    mean, half = curve.mean.numpy(), QUANTILE * curve.std.numpy()
    law = np.zeros((len(v), robot.nv))
    law[:, joint] = v
    axes.plot(v, -joint_friction_of(CONFIG, robot)(law)[:, joint], color=TRUTH, linewidth=3.5, alpha=0.3, label="true")
    draw_band(axes, v, mean, half, alpha=0.4, label="95 % interval")
    axes.plot(v, mean, color=PREDICTION, linewidth=1.2, label="learned friction (green on the arm)")
    (dot,) = axes.plot(velocity[:1], now[:1], "o", color=IDENTIFIED, markersize=6.0, zorder=5)
    quiet(axes, title=f"joint {joint + 1}", x="velocity [rad/s]", y="torque [Nm]" if joint == CURVES[0] else "")
    return lambda frame: dot.set_data(velocity[frame : frame + 1], now[frame : frame + 1])


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    arm, model, found = motions()
    first, *others = film(arm, model, found)
    more = {"duration": 1000 // FRAMES_PER_SECOND, "loop": 0, "optimize": True}
    first.save(FOLDER / "tracking.gif", save_all=True, append_images=others, **more)
