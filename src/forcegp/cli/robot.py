"""`forcegp robot`: what a robot file says, what was repaired, and what it looks like."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.evaluation
import forcegp.report
from forcegp.cli.command import URDF, require_free_file, unless_given
from forcegp.cli.input_options import RobotFileOptions
from forcegp.cli.terminal import Terminal, columns, shown
from forcegp.errors import RobotFileWarning

NONE = (math.inf, -math.inf)
"""Limits that there are not; JSON has no number for them."""


@dataclass(frozen=True, kw_only=True)
class Robot(RobotFileOptions):
    """Print the content of a robot file: its tree, joints, limits and masses, and what was ignored or repaired.

    Every problem of the file is named at once, with the options under which it is taken. FILE is a URDF, or a xacro
    file where the package xacro is installed; meshes are not needed.

    For example:
      forcegp robot arm.urdf
      forcegp robot dog.urdf --base floating
      forcegp robot arm.urdf --inertias nearest --lock finger=0 --out arm.png
      forcegp robot arm.urdf --browser
    """

    interrupted = "the page is closed"

    file: Annotated[Positional[Path], URDF, arg(metavar="FILE")]
    """The robot file."""
    strict: bool = False
    """Refuse what is ignored otherwise: a negative limit, a second axis, a missing name."""
    out: Annotated[Path | None, unless_given("FILE.png", "no picture")] = None
    """Draw the robot into this file."""
    browser: bool = False
    """Show the robot in the browser, until Ctrl-C."""
    overwrite: bool = False
    """Replace the picture."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Read, show, and draw if asked to."""
        if self.out is not None:
            png = lambda path: path.read_bytes().startswith(b"\x89PNG")  # noqa: E731
            require_free_file(self.out, overwrite=self.overwrite, own=png, what="a PNG")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", RobotFileWarning)
            robot = forcegp.Robot.from_urdf(self.file, inertias=self.inertias, strict=self.strict, **self._changes())
        repaired = [str(warning.message) for warning in caught]
        for text in repaired:
            terminal.warn(text)
        content = _content(robot) | {"file": str(self.file), "repaired": repaired}
        terminal.show(*_shown(robot, content))
        if self.out is not None or self.browser:
            scene = forcegp.report.still_scene(robot, self.file)
            if scene.doubts:
                terminal.note(f"{len(scene.doubts)} meshes are drawn as capsules, for example: {scene.doubts[0]}")
            if self.out is not None:
                forcegp.evaluation.save_figure(forcegp.report.robot_figure(scene), self.out)
                content["picture"] = str(self.out)
                terminal.note(f"picture: {self.out}")
            if self.browser:
                forcegp.report.serve(scene, ready=lambda url: terminal.note(f"open {url}; Ctrl-C ends it"))
        return content


def _content(robot: forcegp.Robot) -> dict[str, Any]:
    links = [robot.link(name) for name in robot.link_names]
    joints = [asdict(joint) | {"armature": x} for joint, x in zip(robot.joints, robot.armature.tolist(), strict=True)]
    mimics = {
        body.name: {**drive._asdict(), "joint": robot.joint_names[drive.joint]}
        for body, drive in zip(robot.layout.bodies, robot.layout.drives, strict=True)
        if body.name not in robot.joint_names
    }
    return {
        "name": robot.name,
        "base": robot.base,
        "moving_mass": sum(link.mass for link in links if link.joint is not None),
        "joints": [{name: None if value in NONE else value for name, value in joint.items()} for joint in joints],
        "mimics": mimics,
        "locked": robot.locked,
        "links": [{"name": link.name, "mass": link.mass, "joint": link.joint} for link in links],
    }


def _shown(robot: forcegp.Robot, content: Mapping[str, Any]) -> list[Any]:
    """The tree and the table of joints."""
    from rich.text import Text
    from rich.tree import Tree

    def line(name: str, moved: str) -> Text:
        mass = robot.link(name).mass
        return Text.assemble((name, "bold" if mass else ""), f" {mass:.4g} kg" if mass else "", (moved, "dim"))

    root = next(iter(robot.layout.links))
    tree = Tree(line(root, "" if robot.base == "fixed" else f"  ({robot.base})"))
    branches = {root: tree}
    for joint in robot.all_joints:
        mimic = content["mimics"].get(joint.name)
        how = "locked" if joint.name in robot.locked else joint.type
        how += "" if mimic is None else " = {multiplier:g} {joint} {offset:+g}".format(**mimic)
        branches[joint.child] = branches[joint.parent].add(line(joint.child, f"  {joint.name} ({how})"))
    header = {"lower": "lower", "upper": "upper", "velocity": "velocity_limit", "effort": "effort_limit"}
    header |= {name: name for name in ("damping", "friction", "armature")}
    rows = [[each["name"], *(shown(each[key]) for key in header.values())] for each in content["joints"]]
    title = f"{robot.name}: {robot.nv} joints, {content['moving_mass']:.4g} kg that move; in rad or m, s, Nm or N"
    return [tree, columns(title, ["joint", *header], rows, long_names=True)]
