"""Robot files: changed structure, numbers and bytes, other encodings, entities."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from hypothesis import strategies as st
from tests.fuzz.oracle import DefectError, Target, allowed, require_no_code
from tests.fuzz.values import DAMAGE, MJCF_EDITS, PROLOGUES, XML_EDITS, Damage, XmlEdit, damaged, edited_xml
from tests.posterior.arm import URDF
from tests.robots.mjcf_models import ALL
from tests.robots.random_positions import random_positions

from forcegp import Model, Robot

SECRET = "nobody may read this"


@dataclass(frozen=True)
class RobotFile:
    """A robot with these edits, after this prologue, damaged, held so."""

    edits: list[XmlEdit]
    prologue: str
    damage: Damage | None
    robot: str = "arm"
    base: Any = None


MIMIC = """<robot name="hand"><link name="palm"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="left" type="prismatic"><parent link="palm"/><child link="l"/><axis xyz="0 1 0"/><limit lower="0" upper="1"
effort="1" velocity="1"/></joint><link name="l"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="right" type="revolute"><parent link="palm"/><child link="r"/><axis xyz="1 0 0"/><mimic joint="left"
multiplier="-1.5" offset="0.1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint><link name="r"><inertial>
<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
FREE = (
    MIMIC.replace('type="prismatic"', 'type="floating"')
    .replace('<mimic joint="left"', "<mimic")
    .replace('<mimic\nmultiplier="-1.5" offset="0.1"/>', "")
)
ROBOTS = {"arm": URDF, "mimic": MIMIC, "free": FREE} | {f"mjcf {name}": text for name, text in ALL.items()}
BASES = (None, "fixed", "floating", "planar", "", "Floating", 5, ("floating",), ["planar"], {}, b"planar")
CASES = st.builds(
    RobotFile, st.lists(XML_EDITS, max_size=4), st.sampled_from(("none",) * 12 + tuple(PROLOGUES)),
    st.none() | st.none() | st.none() | DAMAGE,
)  # fmt: skip
NEW = st.builds(
    RobotFile, st.lists(MJCF_EDITS | MJCF_EDITS | XML_EDITS, max_size=2),
    st.sampled_from(("none",) * 400 + tuple(PROLOGUES)),
    st.sampled_from(range(12)).flatmap(lambda k: st.none() if k else DAMAGE), st.sampled_from(tuple(ROBOTS)),
    st.sampled_from(BASES[:5] * 8 + BASES),
)  # fmt: skip


def write(case: RobotFile, path: Path) -> None:
    (path.parent / "secret.txt").write_text(SECRET)
    content = PROLOGUES[case.prologue] + edited_xml(ROBOTS[case.robot], case.edits).encode("utf-8", "replace")
    path.write_bytes(content if case.damage is None else damaged(content, case.damage))


def check(case: RobotFile, folder: Path) -> None:
    path = folder / ("arm.xml" if case.robot.startswith("mjcf") else "arm.urdf")
    write(case, path)
    try:
        model = Model.from_file(path, base=case.base)
        robot = model.robot
        repr(model)
        if robot.nv:
            q = random_positions(robot, torch.Generator().manual_seed(0))[0]
            if not bool(torch.isfinite(robot.mass_matrix(q)).all()):
                raise DefectError("a mass matrix that is not finite")
            model.dynamics(q, torch.zeros(robot.nv).double(), torch.zeros(len(model.inputs)).double())
        if Robot.from_urdf_text(robot.to_urdf(), base=robot.base, locked=robot.locked).nv != robot.nv:
            raise DefectError("another robot is read from what was written")
        Model.from_json(model.to_json())
        if case.robot.startswith("mjcf") and case.damage is None:
            Robot.from_mjcf_text(path.read_text(errors="replace"), base=case.base)
        model.to_mjcf()
    except Exception as error:
        if SECRET in str(error):
            raise DefectError("an external entity was read") from None
        with allowed():
            raise
    require_no_code(folder)


TARGET = Target(CASES | NEW, check, fast=40, nightly=3000)
