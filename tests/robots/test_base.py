"""Who is asked whether the robot is bolted to the world, and who is not."""

import pinocchio as pin
import pytest
import torch
from tests.robots.robot_models import MODELS

from forcegp.errors import UnstatedBase
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.robots.layout import BaseChoice

BODY = '<inertial><mass value="{}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'


def limbs(*names: str, root: str = "trunk", mass: float = 5.0, robot: str = "r", joint: str = "joint_{}") -> str:
    """A body with a limb for every name."""
    parts = [f'<robot name="{robot}"><link name="{root}">{BODY.format(mass)}</link>']
    for name in names:
        ends = f'<parent link="{root}"/><child link="{name}"/>'
        parts.append(f'<joint name="{joint.format(name)}" type="continuous">{ends}<origin xyz="0.1 0 0"/></joint>')
        parts.append(f'<link name="{name}">{BODY.format(1.0)}</link>')
    return "".join([*parts, "</robot>"])


LOOSE = {
    "legs": limbs("FL_foot", "FR_foot"),
    "upper and lower leg": limbs("leftUpperLeg", "left_lowerLEG"),
    "wheels": limbs("wheel_1", "rear_wheels"),
    "propellers": limbs("a", "b", "c", joint="rotor_{}"),
    "a humanoid without legs": limbs("arm", root="Pelvis"),
    "a flying arm": limbs("arm", robot="flying_arm"),
}
BOLTED = {
    **{name: text() for name, text in MODELS.items()},
    "a hand": limbs("index", "middle", "ring", "thumb", root="palm"),
    "a gripper": limbs("left_finger", "right_finger"),
    "a base footprint": limbs("arm", root="base_footprint"),
    "one wheel": limbs("reaction_wheel", "arm"),
    "rotors of two motors": limbs("arm", "rotor_1", "rotor_2"),
    "a console": limbs("console", "chip", "pushing_hippo"),
    "a massless base": limbs("l_foot", "r_foot", mass=0.0).replace(BODY.format(0.0), ""),
}


@pytest.mark.parametrize("name", LOOSE)
def test_robots_that_walk_drive_or_fly_are_asked(name):
    with pytest.raises(UnstatedBase, match=r"not bolted.*base='floating' lets.*base='fixed' takes") as caught:
        Robot.from_urdf_text(LOOSE[name])
    assert caught.value.remedy == {"base": "floating"}
    assert "--base floating" in str(caught.value)
    robot = Robot.from_urdf_text(LOOSE[name], **caught.value.remedy)
    assert (robot.base, robot.nq - robot.nv) == ("floating", 1)
    bolted = Robot.from_urdf_text(LOOSE[name], base="fixed")
    for each in (robot, bolted):
        again = each.with_armature([0.1] * each.nv)  # and nobody asks again
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
    welded = Robot.from_urdf_text(text.replace('"fixed"', '"floating"'), base="fixed")
    q = torch.zeros(2).double()
    assert torch.equal(welded.mass_matrix(q), Robot.from_urdf_text(text).mass_matrix(q))
