"""A recorded scene as a file of rerun (.rrd): links, arrows, and every force and position over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from forcegp.atomic_files import atomic_file
from forcegp.errors import required_extra
from forcegp.report.motion import RecordedScene
from forcegp.report.scene import COLORS, DARK_LINK, LINK, quaternion


def write_rerun(path: str | Path, recorded: RecordedScene, *, overwrite: bool = False) -> None:
    """Write the file; open it with `rerun FILE`. Time is the timeline "time" in s.

    Raises MissingExtra without rerun-sdk, InvalidInput where the file is there or its folder is not.
    """
    rr = required_extra("rerun", "rerun", "a log for its viewer")
    with atomic_file(path, overwrite=overwrite) as temporary:
        stream = rr.RecordingStream("forcegp")
        stream.save(str(temporary))
        stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for place, shape in enumerate(recorded.shapes):
            color = DARK_LINK if place % 2 else LINK
            mesh = rr.Mesh3D(vertex_positions=shape.vertices, triangle_indices=shape.faces, albedo_factor=[*color, 255])
            stream.log(rr.new_entity_path(["robot", shape.link]), mesh, static=True)
        for place, contact_path in enumerate(recorded.paths):
            stream.log(rr.new_entity_path(["paths", str(place)]), rr.LineStrips3D([contact_path]), static=True)
        for row, seconds in enumerate(recorded.time):
            stream.set_time("time", duration=float(seconds))
            _log_row(rr, stream, recorded, row)
        stream.disconnect()


def _log_row(rr: Any, stream: Any, recorded: RecordedScene, row: int) -> None:
    for place, shape in enumerate(recorded.shapes):
        pose = recorded.poses[row, place]
        placed = rr.Transform3D(translation=pose[:3, 3], quaternion=np.roll(quaternion(pose[:3, :3]), -1))
        stream.log(rr.new_entity_path(["robot", shape.link]), placed)
    for joint, name in enumerate(recorded.robot.joint_names):
        stream.log(rr.new_entity_path(["q", name]), rr.Scalars(float(recorded.q[row, joint])))
    for number, group in enumerate(recorded.arrows):
        mean, _ = group.tips(row, recorded.arrow_length)
        arrows = rr.Arrows3D(origins=mean[:, 0], vectors=mean[:, 1] - mean[:, 0], colors=[COLORS[number % len(COLORS)]])
        stream.log(rr.new_entity_path(["arrows", group.title]), arrows)
        for place, name in enumerate(group.names):
            middle, half = group.mean[row, place], group.half[row, place]
            for kind, value in (("mean", middle), ("low", middle - half), ("high", middle + half)):
                stream.log(rr.new_entity_path(["force", group.title, name, kind]), rr.Scalars(float(value)))
