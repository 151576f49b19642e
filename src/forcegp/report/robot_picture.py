"""A robot by itself: a picture of its links and joint axes, and the scene of one posture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from forcegp.report.motion import RecordedScene
from forcegp.report.shapes import link_shapes, poses_of_links, reach
from forcegp.robots import Robot
from forcegp.scores.figures import style

LINK = "#B9C0C8"
AXIS = 0.12
"""Length of a joint axis relative to the reach of the robot."""


def still_scene(robot: Robot, urdf: str | Path | None = None) -> RecordedScene:
    """The robot at rest, as `link_shapes` draws it: at zero, or where limits exclude that, at the nearest limit."""
    limits = np.array([(joint.lower, joint.upper) for joint in robot.joints])
    step = torch.tensor(np.clip(np.zeros(robot.nv), limits[:, 0], limits[:, 1]))
    q = robot.integrate(robot.neutral(), step).numpy()[None]
    shapes, doubts = link_shapes(robot, urdf)
    poses = poses_of_links(robot, torch.tensor(q), [shape.link for shape in shapes])
    return RecordedScene(robot, np.zeros(1), q, shapes, poses, [], [], reach(robot), doubts)


def robot_figure(scene: RecordedScene) -> Figure:
    """The links of a scene at its first row, and the axes of the joints with their names."""
    figure = Figure(figsize=(7.0, 7.0))
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    ends = [np.zeros((1, 3))]
    for shape, pose in zip(scene.shapes, scene.poses[0], strict=True):
        vertices = shape.vertices @ pose[:3, :3].T + pose[:3, 3]
        faces = vertices[shape.faces]
        faces = faces[np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]).any(1)]  # others have no normal
        if len(faces):
            axes.add_collection3d(Poly3DCollection(faces, facecolors=LINK, shade=True, alpha=0.7))
        ends.append(vertices)
    state = scene.robot.kinematics(torch.from_numpy(scene.q[0]))
    for joint in map(scene.robot.joint, scene.robot.single_joint_names):
        pose = state.frame_pose(joint.child).numpy()
        line = pose[:3, 3] + np.outer((0.0, AXIS * scene.size), pose[:3, :3] @ joint.axis)
        axes.plot(*line.T, color=style.PREDICTION, linewidth=1.5)
        x, y, z = line[1]
        axes.text(x, y, z, joint.name, size=style.SMALL, color=style.TRUTH)
    low, high = np.concatenate(ends).min(axis=0), np.concatenate(ends).max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * float((high - low).max())
    axes.set(**{f"{x}lim": (m - half, m + half) for x, m in zip("xyz", middle, strict=True)})
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title=scene.robot.name, box_aspect=(1.0, 1.0, 1.0))
    style.FigureCanvasAgg(figure)
    return figure
