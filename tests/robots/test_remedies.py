"""One report names all problems of a file, and its remedy takes the file."""

import re
import warnings

import pytest
import torch
from tests.robots.test_base import LOOSE
from tests.robots.test_urdf_errors import SMALL, changed

from forcegp.errors import (
    NonPhysicalInertia,
    RobotFileWarning,
    RobotModelError,
)
from forcegp.robots import Robot
from forcegp.robots.arguments import LISTED, Problems

FLAT = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="3"/>'
FRAME = '<link name="frame"/><joint name="slip" type="prismatic"><parent link="FL_foot"/><child link="frame"/></joint>'
MANY = LOOSE["legs"].replace('<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>', FLAT)
MANY = MANY.replace("</robot>", f"{FRAME}</robot>")


def test_all_problems_are_in_one_report_with_one_remedy():
    with pytest.raises(RobotModelError) as caught:
        Robot.from_urdf_text(MANY, source="dog.urdf")
    message, error = str(caught.value), caught.value
    assert message.startswith("dog.urdf: 4 problems: ")
    assert all(part in message for part in ("'FL_foot'", "'FR_foot'", "'slip'", "not bolted"))
    assert message.count("Correct its <inertial>") == 1  # what to do is said once
    assert message.count("dog.urdf") == 1
    assert len(error.problems) == 4
    assert error.remedy == {"inertias": "nearest", "locked": {"slip": 0.0}, "base": "floating"}
    assert "Robot.from_urdf(path, inertias='nearest', locked={'slip': 0.0}, base='floating')" in message
    assert message.endswith("or --inertias nearest --lock slip=0 --base floating.")
    with pytest.warns(RobotFileWarning, match=r"FL_foot.*FR_foot") as warned:
        robot = Robot.from_urdf_text(MANY, **error.remedy)
    assert len(warned) == 1
    assert robot.joint_names[6:] == ("joint_FL_foot", "joint_FR_foot")


def test_the_remedy_keeps_what_was_given():
    with pytest.raises(RobotModelError, match=r"--lock joint_FR_foot=0\.123456789,slip=0") as caught:
        Robot.from_urdf_text(MANY, locked={"joint_FR_foot": 0.123456789}, inertias="nearest")
    assert caught.value.remedy == {
        "locked": {"joint_FR_foot": 0.123456789, "slip": 0.0},
        "base": "floating",
        "inertias": "nearest",
    }


def test_what_must_be_corrected_in_the_file_leaves_no_remedy():
    with pytest.raises(RobotModelError, match=r"4 problems: .*two.*The remedy for the others, when the file") as caught:
        Robot.from_urdf_text(MANY.replace('mass value="1.0"', 'mass value="two"', 1))
    assert caught.value.remedy == {}
    assert "inertias='nearest'" in str(caught.value)


def test_many_alike_are_counted():
    problems = Problems("file")
    problems.errors = [NonPhysicalInertia(f"file: link {k}", "; correct it.", {}) for k in range(LISTED + 5)]
    with pytest.raises(NonPhysicalInertia, match=rf"link {LISTED - 1}; and 5 more like these; correct it\.$") as caught:
        problems.raise_all()
    assert len(caught.value.problems) == LISTED + 5


IGNORED = {
    "a negative <limit> velocity is taken as no limit": changed('velocity="3"', 'velocity="-1"'),
    "a negative <limit> effort is taken as no limit": changed('effort="5"', 'effort="-5"'),
    "a lower limit above the upper one is taken as no limit": changed('upper="1"', 'upper="-2"'),
    "the first of several <axis> counts": changed("<limit", '<axis xyz="1 0 0"/><limit'),
    "the first of several <inertial> counts": changed("</link>\n</robot>", "<inertial/></link></robot>"),
    "the first of several <limit> counts": changed("</joint>", '<limit lower="-9" effort="9"/></joint>'),
    "a negative <dynamics> damping is taken as none": changed("<axis", '<dynamics damping="-0.1"/><axis'),
    "a product of inertia that is not given is 0": changed(' ixy="0"', ""),
    "an <inertial> without mass is left out": changed('<link name="base"/>', '<link name="base"><inertial/></link>'),
    "a <robot> without a name is called 'robot'": changed(' name="small"', ""),
}


@pytest.mark.parametrize("what", IGNORED)
def test_what_can_be_ignored_is_a_warning(what):
    with pytest.warns(RobotFileWarning, match=f"here: {what}"):
        robot = Robot.from_urdf_text(IGNORED[what], source="here")
    q = torch.ones(1).double()
    assert torch.equal(robot.mass_matrix(q), Robot.from_urdf_text(SMALL).mass_matrix(q))
    joint = robot.joint("hinge")
    assert (joint.velocity_limit, joint.effort_limit, joint.lower).count(float("inf")) == ("negative <limit>" in what)
    assert joint.lower == (-float("inf") if "lower" in what else -1.0)
    robot.with_armature([0.1])  # nothing is said twice


def test_a_mass_without_inertia_is_a_point_where_that_is_asked_for():
    text = re.sub("<inertia .*/>", "", SMALL)
    with pytest.raises(NonPhysicalInertia, match="add it, or take the mass as a point") as caught:
        Robot.from_urdf_text(text)
    with pytest.warns(RobotFileWarning, match=r"taken as a point \(link 'arm'\)"):
        robot = Robot.from_urdf_text(text, **caught.value.remedy)
    assert robot.mass_matrix(torch.zeros(1).double()).item() == pytest.approx(2 * 0.1**2, rel=1e-12)
    assert robot.tree.equals(Robot.from_urdf_text(robot.to_urdf()).tree)


def test_a_joint_without_direction_is_offered_to_be_locked():
    text = MANY.replace('<child link="FL_foot"/>', '<child link="FL_foot"/><axis xyz="0 0 0"/>')
    with pytest.raises(RobotModelError, match=r"'joint_FL_foot': <axis> .* has no direction") as caught:
        Robot.from_urdf_text(text)
    with warnings.catch_warnings(action="ignore"):
        robot = Robot.from_urdf_text(text, **caught.value.remedy)
    assert robot.joint_names[6:] == ("joint_FR_foot",)
