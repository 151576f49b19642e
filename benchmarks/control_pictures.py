"""The pictures of docs/how-to/control.md, of one seed: `tracking` over time and as a film, contacts, and an excitation.

python -m benchmarks.control_pictures
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure

import forcegp
from benchmarks.contact_monitor import EVERY, LASTING, monitors, qvu, recordings
from benchmarks.excitation import LIMITS, Learner
from benchmarks.tracking import GAINS, MIDDLE, RATE, controllers, excitation, followed, robot_of, rows_of, task_of
from forcegp import MechanicalSystem, PDGravity, Robot
from forcegp.evaluation import contacts_figure, excitation_figure
from forcegp.evaluation.plots.style import MEASUREMENT, PREDICTION, SERIES, SMALL, TRUTH, new_figure, quiet, save_figure

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "how-to" / "control"
SEED, SECONDS, FRAMES_PER_SECOND = 1, 10.0, 12
SHOWN = ("URDF", "learned")


def motions() -> tuple[Robot, dict[str, dict[str, np.ndarray]]]:
    """Controller -> what the arm did."""
    robot = robot_of()
    given, task = MechanicalSystem(robot), task_of(SEED)
    rows = rows_of(followed(robot, excitation(SEED), PDGravity(robot.compile(), **GAINS), 20.0), given, SEED)
    found = controllers(rows, given, robot, SEED)
    return robot, {name: followed(robot, task, control, SECONDS) for name, control in found.items()}


def errors(done: dict[str, dict[str, np.ndarray]]) -> Figure:
    """Root mean square over the joints, over time."""
    figure = new_figure(8.0, 3.4)
    axes = figure.subplots()
    colors = dict(zip(done, (MEASUREMENT, SERIES[1], SERIES[2], PREDICTION, TRUTH), strict=True))
    for name, motion in done.items():
        time = np.arange(len(motion["e"])) / RATE
        size = 1e3 * np.sqrt(np.mean(motion["e"] ** 2, axis=1))
        style = "--" if name == "true model" else "-"
        axes.semilogy(time, np.maximum(size, 1e-2), style, color=colors[name], linewidth=1.4, label=name)
    axes.set_ylim(0.1, 400.0)
    quiet(
        axes,
        title="KUKA iiwa with Stribeck friction, equal gains, 100 rows to learn from",
        x="time [s]",
        y="error [mrad]",
    )
    figure.legend(fontsize=SMALL, frameon=False, loc="outside lower center", ncols=5)
    return figure


def links(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Origins of the links (n, links, 3) in m."""
    kinematics = robot.kinematics(torch.tensor(q))
    names = [joint.child for joint in robot.joints]
    return torch.stack([kinematics.frame_pose(name)[..., :3, 3] for name in names], dim=1).numpy()


def film(robot: Robot, done: dict[str, dict[str, np.ndarray]]) -> FuncAnimation:
    """The arm under two controllers, beside the reference in grey."""
    figure = new_figure(7.2, 3.6)
    every = slice(None, None, RATE // FRAMES_PER_SECOND)
    drawn = {}
    for place, name in enumerate(SHOWN):
        motion = done[name]
        axes = figure.add_subplot(1, 2, place + 1, projection="3d")
        arm, wanted = (links(robot, q[every]) for q in (motion["q"], motion["q"] + motion["e"]))
        for values, color, width in ((wanted, "0.75", 6.0), (arm, SERIES[1] if name == "URDF" else PREDICTION, 2.5)):
            (line,) = axes.plot(*values[0].T, "o-", color=color, linewidth=width, markersize=0.8 * width)
            (trace,) = axes.plot(*values[:1, -1].T, color=color, linewidth=0.4 * width)
            drawn[line, trace] = values
        middle = np.concatenate([arm, wanted]).reshape(-1, 3)
        low, high = middle.min(0), middle.max(0)
        axes.set_box_aspect(high - low, zoom=1.55)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_axis_off()
        axes.view_init(elev=18, azim=-60)
        error = 1e3 * float(np.sqrt(np.mean(motion["e"][RATE:] ** 2)))
        axes.set_title(f"computed torque, {name}: {error:.3g} mrad", fontsize=SMALL, color=TRUTH)

    def draw(frame: int) -> list[object]:
        for (line, trace), values in drawn.items():
            line.set_data_3d(*values[frame].T)
            trace.set_data_3d(*values[max(0, frame - 20) : frame + 1, -1].T)
        return [artist for pair in drawn for artist in pair]

    return FuncAnimation(figure, draw, frames=len(next(iter(drawn.values()))))


def contacts() -> tuple[Figure, Figure]:
    """Pushes of 5 N over 8 s, and what every monitor finds of 3 N at any rate of false alarms."""
    found = recordings(SEED)
    made = monitors(SEED, found["calibration"])
    rows, monitor = slice(0, round(8.0 * RATE)), made["learned"]
    some = {name: x[rows] for name, x in found["5 N"].items()}
    state, time = monitor.run(*qvu(some)), np.arange(len(some["q"])) / RATE
    pushes = [(start, start + LASTING) for start in np.arange(0.0, 8.0, EVERY)]
    arrays = time, state.distance.numpy(), monitor.threshold, state.torque.numpy()
    one = contacts_figure(*arrays, pushes, monitor.robot.joint_names, "KUKA iiwa, pushed with 5 N at the elbow")
    curves = new_figure(6.4, 3.6)
    axes = curves.subplots()
    period, window = round(EVERY * RATE), round(LASTING * RATE)
    for color, (name, each) in zip((MEASUREMENT, SERIES[1], PREDICTION, TRUTH), made.items(), strict=False):
        free = each.run(*qvu(found["free"])).distance.numpy()
        pushed = each.run(*qvu(found["3 N"])).distance.numpy()
        largest = pushed[: len(pushed) // period * period].reshape(-1, period)[:, : window + 1].max(axis=1)
        blocks = free[: len(free) // RATE * RATE].reshape(-1, RATE).max(axis=1)  # of one second
        limits = np.sort(np.concatenate([blocks, largest]))
        rate = [3600.0 * (blocks > limit).mean() for limit in limits]
        share = [(largest > limit).mean() for limit in limits]
        style = "--" if name == "true model" else "-"
        axes.plot(np.maximum(rate, 6.0), share, style, color=color, linewidth=1.6, label=name)
    axes.set(xscale="log", xlim=(6.0, 3600.0), ylim=(0.0, 1.02))
    quiet(
        axes,
        title="Pushes of 3 N at the elbow, half a second each",
        x="false alarms per hour (6: none in 10 min)",
        y="found",
    )
    curves.legend(fontsize=SMALL, frameon=False, loc="outside lower center", ncols=4)
    return one, curves


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    for name, figure in zip(("monitor", "monitor-rates"), contacts(), strict=True):
        save_figure(figure, FOLDER / f"{name}.png")
    arm, found = motions()
    save_figure(errors(found), FOLDER / "tracking.png")
    film(arm, found).save(FOLDER / "tracking.gif", PillowWriter(fps=FRAMES_PER_SECOND), dpi=80)
    learner = Learner(SEED)
    chosen = forcegp.excitation(learner.before, limits=LIMITS, start=MIDDLE, task=learner.task, seed=SEED)
    save_figure(excitation_figure(chosen), FOLDER / "excitation.png")
