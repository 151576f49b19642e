"""`forcegp robot` and `view`: what a robot file says, and a recording in 3D."""

from __future__ import annotations

import math
import tempfile
import warnings
import webbrowser
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import forcegp
import forcegp.report
from forcegp.atomic_files import MARK, is_marked, write_text
from forcegp.cli.command import THERE, URDF, Command, unless_given
from forcegp.cli.robot_options import RobotFileOptions
from forcegp.cli.terminal import Terminal, columns, shown
from forcegp.errors import InvalidInput, RobotFileWarning, require_known

NONE = (math.inf, -math.inf)  # limits that there are not; JSON has no number for them


@dataclass(frozen=True, kw_only=True)
class Robot(Command):
    """Print the content of a robot file: its tree, joints, limits and masses, and what was ignored or repaired.

    Every problem of the file is named at once, with the options under which it is taken. FILE is a URDF, MJCF where
    the package mujoco is installed, or xacro where xacro is; meshes are not needed where masses are given.

    For example:
      forcegp robot arm.urdf
      forcegp robot dog.urdf --base floating
      forcegp robot arm.urdf --inertias nearest --lock finger=0
      forcegp robot identified/identified.urdf --out arm.xml
    """

    robot: Annotated[Positional[Path], URDF, arg(metavar="FILE")]
    """The robot file."""
    out: Annotated[Path | None, unless_given("FILE.xml|urdf", "no file")] = None
    """The robot as MJCF (.xml, .mjcf) or URDF."""
    reading: RobotFileOptions = RobotFileOptions()

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Read, show, and write if asked to."""
        if self.out is not None:
            require_known("extension", self.out.suffix, "--out", (".xml", ".mjcf", ".urdf"))
        self.require_free_file(self.out, is_marked, "a robot file of forcegp")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", RobotFileWarning)
            model = forcegp.Model.from_file(self.robot, inertias=self.reading.inertias, **self.reading.changes())
            robot = model.robot
        repaired = [str(warning.message) for warning in caught]
        for text in repaired:
            terminal.warn(text)
        content = _content(robot) | {"file": str(self.robot), "repaired": repaired}
        content["inputs"] = list(model.inputs)
        if self.out is not None:
            text, mark = robot.to_urdf() if self.out.suffix == ".urdf" else model.to_mjcf(), f"<!-- {MARK} -->\n"
            write_text(self.out, text.removesuffix(mark) + mark, overwrite=self.overwrite)
        terminal.show(*_shown(robot, content))
        if self.out is not None:
            content["written"] = str(self.out)
            terminal.note(f"wrote {self.out}")
        return content


def _content(robot: forcegp.Robot) -> dict[str, Any]:
    masses, layout = {name: robot.link(name).mass for name in robot.link_names}, robot.layout
    moved_by = {name: layout.bodies[layout.links[name].body].name for name in layout.moving}
    joints = [asdict(joint) | {"armature": x} for joint, x in zip(robot.joints, robot.armature.tolist(), strict=True)]
    for joint in joints:  # places are those of the file; what mimics stands below
        del joint["origin"], joint["mimics"]
    mimics = {
        body.name: {**drive._asdict(), "joint": robot.joint_names[drive.joint]}
        for body, drive in zip(robot.layout.bodies, robot.layout.drives, strict=True)
        if body.name not in robot.joint_names
    }
    return {
        "name": robot.name, "base": robot.base, "moving_mass": sum(masses[name] for name in layout.moving),
        "joints": [{name: None if value in NONE else value for name, value in joint.items()} for joint in joints],
        "mimics": mimics, "locked": robot.locked,
        "links": [{"name": name, "mass": mass, "joint": moved_by.get(name)} for name, mass in masses.items()],
    }  # fmt: skip


def _shown(robot: forcegp.Robot, content: Mapping[str, Any]) -> list[Any]:
    from rich.text import Text
    from rich.tree import Tree

    def line(name: str, moved: str) -> Text:
        mass = robot.link(name).mass
        return Text.assemble((name, "bold" if mass else ""), f" {mass:.4g} kg" if mass else "", (moved, "dim"))

    root = next(iter(robot.layout.links))
    tree = Tree(line(root, f"  ({robot.base})" if root in robot.layout.moving else ""))
    branches = {root: tree}
    moving = {"fixed", *(each.name for each in (*robot.layout.bodies, *robot.layout.groups))}
    for joint in robot.all_joints:
        mimic = content["mimics"].get(joint.name)
        how = joint.type if {joint.name, joint.type} & moving else "locked"
        if mimic is not None:
            times = {1.0: "", -1.0: "-"}.get(mimic["multiplier"], f"{mimic['multiplier']:g} ")
            how += f" = {times}{mimic['joint']}" + (f" {mimic['offset']:+g}" if mimic["offset"] else "")
        branches[joint.child] = branches[joint.parent].add(line(joint.child, f"  {joint.name} ({how})"))
    header = {"lower": "lower", "upper": "upper", "velocity": "velocity_limit", "effort": "effort_limit"}
    header |= {name: name for name in ("damping", "friction", "armature")}
    rows = [[each["name"], *(shown(each[key]) for key in header.values())] for each in content["joints"]]
    title = f"{robot.name}: {robot.nv} joints, {content['moving_mass']:.4g} kg that move; in rad or m, s, Nm or N"
    inputs = [f"u: {', '.join(content['inputs']) or 'none'}"] if tuple(content["inputs"]) != robot.joint_names else []
    return [tree, *inputs, columns(title, ["joint", *header], rows, long_names=True)]


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Show a recording in 3D in the browser, with the forces of a model as arrows, or the recorded torques.

    The page is one file, which can be sent around. It plays the motion; a slider chooses the time.

    For example:
      forcegp view run test.h5 --shapes arm.urdf
      forcegp view log.h5 --out log.html
    """

    paths: Annotated[Positional[tuple[Path, ...]], THERE, arg(metavar="[RUN] LOG", help_behavior_hint="")]
    """A dataset (HDF5), and before it, if wished, the folder of a model."""
    shapes: Annotated[Path | None, URDF, unless_given("ROBOT.urdf", "capsules")] = None
    """What the links look like: a URDF with visual elements, its meshes beside it."""
    start: Annotated[float, arg(metavar="S")] = 0.0
    """Where in the recording to begin, in s."""
    seconds: Annotated[float, arg(metavar="S")] = 10.0
    """How much of it to show."""
    out: Annotated[Path | None, unless_given("FILE.html", "a temporary one, opened in the browser", Path)] = None
    """The page to write; it is not opened then."""

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Write, and open."""
        if len(self.paths) not in (1, 2):
            raise InvalidInput(f"{len(self.paths)} paths were given; give a dataset, or a model and a dataset.")
        *runs, log = self.paths
        self.require_free_file(self.out, is_marked, "a report of forcegp")
        posterior = forcegp.load_posterior(runs[0]) if runs else None
        recorded = forcegp.report.recorded_scene(
            forcegp.Dataset.load(log), posterior, start=self.start, seconds=self.seconds, shapes=self.shapes
        )
        for doubt in recorded.doubts:
            terminal.warn(doubt)
        of = f", with the forces of {runs[0].name}" if runs else ""
        page = forcegp.report.Page(
            f"{log.name}, {recorded.time[-1]:.3g} s{of}", recorded.robot.name,
            scene=forcegp.report.recording(recorded), scene_notes=forcegp.report.scene_notes(recorded),
        )  # fmt: skip
        out = self.out or Path(tempfile.mkdtemp(prefix="forcegp-"), f"{log.stem}.html")
        forcegp.report.write_page(out, page, overwrite=self.overwrite)
        terminal.note(f"page: {out}")
        if self.out is None:
            webbrowser.open(out.resolve().as_uri())
        forces = [{"name": each.title, "unit": each.unit, "arrows": list(each.names)} for each in recorded.arrows]
        return {"rows": len(recorded.time), "seconds": float(recorded.time[-1]), "forces": forces, "html": str(out)}
