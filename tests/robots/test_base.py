"""Who is asked whether the robot is bolted to the world, and who is not."""

import re
import warnings

import pinocchio as pin
import pytest
import torch
from tests.robots.robot_models import MODELS
from tests.robots.test_urdf_errors import SMALL, changed

from forcegp.errors import NonPhysicalInertia, RobotFileWarning, RobotModelError
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.robots.arguments import LISTED, Problems
from forcegp.robots.layout import BaseChoice

BODY = '<inertial><mass value="{}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'


def limbs(*names: str, root: str = "trunk", mass: float = 5.0, robot: str = "r", joint: str = "joint_{}") -> str:
    parts = [f'<robot name="{robot}"><link name="{root}">{BODY.format(mass)}</link>']
    for name in names:
        ends = f'<parent link="{root}"/><child link="{name}"/>'
        parts.append(f'<joint name="{joint.format(name)}" type="continuous">{ends}<origin xyz="0.1 0 0"/></joint>')
        parts.append(f'<link name="{name}">{BODY.format(1.0)}</link>')
    return "".join([*parts, "</robot>"])


LOOSE = {
    "legs": limbs("FL_foot", "FR_foot"), "upper and lower leg": limbs("leftUpperLeg", "left_lowerLEG"),
    "wheels": limbs("wheel_1", "rear_wheels"), "propellers": limbs("a", "b", "c", joint="rotor_{}"),
    "a humanoid without legs": limbs("arm", root="Pelvis"), "a flying arm": limbs("arm", robot="flying_arm"),
}  # fmt: skip
BOLTED = {
    **{name: text() for name, text in MODELS.items()}, "a hand": limbs("index", "middle", "ring", "thumb", root="palm"),
    "a gripper": limbs("left_finger", "right_finger"), "a base footprint": limbs("arm", root="base_footprint"),
    "one wheel": limbs("reaction_wheel", "arm"), "rotors of two motors": limbs("arm", "rotor_1", "rotor_2"),
    "a console": limbs("console", "chip", "pushing_hippo"),
    "a massless base": limbs("l_foot", "r_foot", mass=0.0).replace(BODY.format(0.0), ""),
}  # fmt: skip


@pytest.mark.parametrize("name", LOOSE)
def test_robots_that_walk_drive_or_fly_are_asked(name):
    with pytest.raises(RobotModelError, match=r"not bolted.*base='floating' lets.*base='fixed' takes") as caught:
        Robot.from_urdf_text(LOOSE[name])
    assert caught.value.remedy == {"base": "floating"}
    assert "--base floating" in str(caught.value)
    robot = Robot.from_urdf_text(LOOSE[name], **caught.value.remedy)
    assert (robot.base, robot.nq - robot.nv) == ("floating", 1)
    bolted = Robot.from_urdf_text(LOOSE[name], base="fixed")
    for each in (robot, bolted):
        again = each.with_text(each.urdf_text)  # and nobody asks again
        assert Model.from_json(Model(again).to_json()).robot.base == each.base


@pytest.mark.parametrize("name", BOLTED)
def test_arms_hands_and_grippers_never_are(name):
    assert Robot.from_urdf_text(BOLTED[name]).base == "fixed"


def test_a_free_joint_on_a_body_carries_something_else():
    """A ball that lies on the robot: it does not hold the base, which was welded although the answer was floating."""
    ball = f'<link name="ball">{BODY.format(0.5)}</link><joint name="lies" type="floating">'
    ball += '<parent link="trunk"/><child link="ball"/></joint>'
    text = LOOSE["legs"].replace("</robot>", f"{ball}</robot>")
    answers: dict[BaseChoice, int] = {"fixed": 2, "floating": 8}
    for base, nv in answers.items():
        robot = Robot.from_urdf_text(text, base=base)
        assert (robot.base, robot.nv) == (base, nv + 6)
        assert Robot.from_stored(robot.to_stored()).tree.equals(robot.tree)
    robot, theirs = Robot.from_urdf_text(text, base="floating"), pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
    assert robot.nv == theirs.nv
    still = pin.crba(theirs, theirs.createData(), pin.neutral(theirs)).diagonal()
    assert torch.allclose(robot.mass_matrix(robot.neutral()).diagonal().sort()[0], torch.tensor(still).sort()[0])


def test_a_file_that_says_so_itself_is_not_asked():
    world = '<link name="world"/><joint name="weld" type="fixed"><parent link="world"/><child link="trunk"/></joint>'
    text = LOOSE["legs"].replace("</robot>", f"{world}</robot>")
    assert Robot.from_urdf_text(text).nv == 2
    free = Robot.from_urdf_text(text.replace('"fixed"', '"floating"'))
    assert (free.base, free.nq, free.nv) == ("floating", 9, 8)
    assert Robot.from_stored(free.to_stored()).tree.equals(free.tree)
    welded, q = Robot.from_urdf_text(text.replace('"fixed"', '"floating"'), base="fixed"), torch.zeros(2).double()
    assert torch.equal(welded.mass_matrix(q), Robot.from_urdf_text(text).mass_matrix(q))


FRAME = '<link name="frame"/><joint name="slip" type="prismatic"><parent link="FL_foot"/><child link="frame"/></joint>'
MANY = LOOSE["legs"].replace('izz="1"', 'izz="3"').replace("</robot>", f"{FRAME}</robot>")


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
        "locked": {"joint_FR_foot": 0.123456789, "slip": 0.0}, "base": "floating", "inertias": "nearest",
    }  # fmt: skip


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
    "a lower limit above the upper one is taken as no limit": changed('upper="1"', 'upper="-2"'),
    "the first of several <axis> counts": changed("<limit", '<axis xyz="1 0 0"/><limit'),
    "a negative <dynamics> damping is taken as none": changed("<axis", '<dynamics damping="-0.1"/><axis'),
    "a product of inertia that is not given is 0": changed(' ixy="0"', ""),
    "an <inertial> without mass is left out": changed('<link name="base"/>', '<link name="base"><inertial/></link>'),
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
