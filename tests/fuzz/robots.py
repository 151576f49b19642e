"""Robot files: changed structure, numbers and bytes, other encodings, entities."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from hypothesis import strategies as st
from tests.fuzz.oracle import DefectError, Target, allowed, require_no_code
from tests.fuzz.values import DAMAGE, PROLOGUES, XML_EDITS, Damage, XmlEdit, damaged, edited_xml
from tests.models.arm import URDF

from forcegp import Robot

SECRET = "nobody may read this"


@dataclass(frozen=True)
class RobotFile:
    """The arm with these edits, after this prologue, damaged."""

    edits: list[XmlEdit]
    prologue: str
    damage: Damage | None


CASES = st.builds(
    RobotFile,
    st.lists(XML_EDITS, max_size=4),
    st.sampled_from(("none",) * 12 + tuple(PROLOGUES)),
    st.none() | st.none() | st.none() | DAMAGE,
)


def write(case: RobotFile, path: Path) -> None:
    """The robot file."""
    (path.parent / "secret.txt").write_text(SECRET)
    content = PROLOGUES[case.prologue] + edited_xml(URDF, case.edits).encode("utf-8", "replace")
    path.write_bytes(content if case.damage is None else damaged(content, case.damage))


def check(case: RobotFile, folder: Path) -> None:
    """Refused, or a robot with numbers."""
    write(case, folder / "arm.urdf")
    try:
        robot = Robot.from_urdf(folder / "arm.urdf")
        repr(robot)
        if robot.nv:
            q = torch.full((robot.nv,), 0.3, dtype=torch.float64)
            M = robot.mass_matrix(q)
            if not bool(torch.isfinite(M).all()):
                raise DefectError("a mass matrix that is not finite")
        text = robot.to_urdf()
        Robot.from_urdf_text(text)
    except Exception as error:
        if SECRET in str(error):
            raise DefectError("an external entity was read") from None
        with allowed():
            raise
    require_no_code(folder)


TARGET = Target(CASES, check, fast=100, nightly=3000)
