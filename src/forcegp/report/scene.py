"""A recorded motion in the scene of viser: nodes that are made once, and what of them moves with each row."""

from __future__ import annotations

import io
import socket
from contextlib import redirect_stdout
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from forcegp.errors import required_extra
from forcegp.report.motion import RecordedScene

LINK, DARK_LINK = (150, 157, 166), (118, 126, 136)
COLORS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0))
"""Okabe and Ito (2008), as the figures, for groups of arrows."""
PALE = 0.55
"""How far the colour of an interval goes towards white."""
PATH = (150, 155, 162)
OPACITY = 0.6
"""Of links: arrows along the axes of joints begin inside of them."""


def recording(recorded: RecordedScene) -> str:
    """The whole motion as one HTML page that needs no server: viser's recording. Raises MissingExtra without viser."""
    viser = required_extra("viser", "view", "drawing the robot")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    with redirect_stdout(io.StringIO()):  # where it prints its address, which results must not be mixed with
        server = viser.ViserServer(host="127.0.0.1", port=port)
    try:
        nodes = SceneNodes(server, recorded)
        serializer = server.get_scene_serializer()
        for row in range(len(recorded.time)):
            nodes.show(row)
            last = row + 1 == len(recorded.time)
            serializer.insert_sleep(0.0 if last else float(recorded.time[row + 1] - recorded.time[row]))
        return serializer.as_html()
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


class SceneNodes:
    """The nodes of one recorded scene. `show(row)` moves them."""

    def __init__(self, server: Any, recorded: RecordedScene) -> None:
        self.recorded = recorded
        scene, size = server.scene, recorded.size
        scene.set_up_direction("+z")
        scene.add_grid("/ground", width=2.0 * size, height=2.0 * size, cell_size=size / 5.0, section_size=size)
        center = recorded.poses[..., :3, 3].mean(axis=(0, 1)) if recorded.shapes else np.zeros(3)
        server.initial_camera.position = tuple(center + size * np.array([0.6, -0.55, 0.28]))
        server.initial_camera.look_at = tuple(center)
        self.links = [
            scene.add_mesh_simple(
                f"/robot/{place}",
                shape.vertices.astype(np.float32),
                shape.faces.astype(np.uint32),
                color=DARK_LINK if place % 2 else LINK,
                opacity=OPACITY,
                flat_shading=True,
            )
            for place, shape in enumerate(recorded.shapes)
        ]
        self.arrows = [_arrows(scene, place, recorded) for place in range(len(recorded.arrows))]
        for place, path in enumerate(recorded.paths):
            if len(path) > 1:
                segments = np.stack([path[:-1], path[1:]], axis=1).astype(np.float32)
                scene.add_line_segments(f"/paths/{place}", segments, colors=PATH)
        self.show(0)

    def show(self, row: int) -> None:
        """The robot and its forces at that row."""
        for place, node in enumerate(self.links):
            pose = self.recorded.poses[row, place]
            node.wxyz, node.position = quaternion(pose[:3, :3]), pose[:3, 3]
        for group, nodes in zip(self.recorded.arrows, self.arrows, strict=True):
            for node, points in zip(nodes, group.tips(row, self.recorded.arrow_length), strict=True):
                node.points = points.astype(np.float32)


def _arrows(scene: Any, place: int, recorded: RecordedScene) -> tuple[Any, Any]:
    """Arrows of the mean, and thinner pale ones to the end of the 95 % interval."""
    color, size = np.array(COLORS[place % len(COLORS)]), recorded.size
    pale = (color + PALE * (255 - color)).astype(np.uint8)
    nodes = []
    for points, kind, shade, width in zip(
        recorded.arrows[place].tips(0, recorded.arrow_length),
        ("mean", "interval"), (color.astype(np.uint8), pale), (0.014, 0.008), strict=True,
    ):  # fmt: skip
        radii = {"shaft_radius": width * size, "head_radius": 2.0 * width * size, "head_length": 2.5 * width * size}
        nodes.append(scene.add_arrows(f"/forces/{place}/{kind}", points.astype(np.float32), shade, **radii))
    return nodes[0], nodes[1]


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of a rotation matrix (3, 3)."""
    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)
