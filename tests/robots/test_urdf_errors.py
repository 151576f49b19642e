"""Each way in which a URDF can be wrong has its own error, which names the file, the culprit and the remedy."""

import os
import re

import numpy as np
import pytest
import torch
from tests.robots.pinocchio_oracle import Oracle

from forcegp import errors
from forcegp.evidence.bodies import thickened
from forcegp.robots import Robot

SMALL = """<robot name="small">
  <link name="base"/>
  <joint name="hinge" type="revolute">
    <parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="5" velocity="3"/>
  </joint>
  <link name="arm">
    <inertial>
      <origin xyz="0.1 0 0"/><mass value="2"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>
    </inertial>
  </link>
</robot>"""
JOINT = '<joint name="{}" type="fixed"><parent link="{}"/><child link="{}"/></joint></robot>'


def changed(old: str, new: str) -> str:
    assert old in SMALL
    return SMALL.replace(old, new)


def with_joint(name: str, parent: str, child: str, links: str = "") -> str:
    return SMALL.replace("</robot>", links + JOINT.format(name, parent, child))


WITHOUT = re.sub("<inertial>.*</inertial>", "", SMALL, flags=re.DOTALL)
ENTITIES = '<!DOCTYPE robot [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]>' + SMALL.replace("small", "&b;")
ROD = '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0"/>'  # along z, the axis of the hinge

WRONG = {
    "empty": ("", ["is empty", "<robot name"]), "not xml": ("robot: small", ["not well-formed XML", "line 1"]),
    "not a robot": ("<sdf/>", ["<sdf>, not <robot>"]), "no links": ('<robot name="r"/>', ["no <link>"]),
    "nothing moves": ('<robot name="r"><link name="a"/></robot>', ["no movable joint"]),
    "entities": (ENTITIES, ["entity", "remove the <!DOCTYPE"]),
    "external dtd": ('<!DOCTYPE robot SYSTEM "file:///etc/passwd">' + SMALL, ["external"]),
    "xacro macro": (
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm side="left"/></robot>',
        ["<arm>", "run xacro first"],
    ),
    "xacro expression": (changed("0.1 0 0", "${length} 0 0"), ["<origin>", "run xacro first"]),
    "link without name": (changed('<link name="base"/>', "<link/>"), ['<link name="...">']),
    "two links of a name": (changed('"base"/>', '"arm"/>'), ["two links", "'arm'", "rename"]),
    "no type": (changed(' type="revolute"', ""), ["joint 'hinge'", "'type'", "add it"]),
    "misspelt type": (changed('"revolute"', '"revolut"'), ["joint 'hinge'", "'revolut'", "did you mean 'revolute'"]),
    "floating inside": (
        with_joint("swing", "arm", "tool", '<link name="tool"/>').replace('"fixed"', '"floating"'),
        ["joint 'swing'", "has no mass", "--lock swing=0"],
    ),
    "mimic of 1e200": (changed("<axis", '<mimic joint="a" multiplier="1e200"/><axis'), ["'hinge'", "above 1e+09"]),
    "mimic of none": (
        changed("<axis", '<mimic joint="other" multiplier="2"/><axis'),
        ["joint 'hinge' mimics 'other'", "which the file lacks", "no movable joint"],
    ),
    "unknown child": (
        changed('<child link="arm"/>', '<child link="amr"/>'),
        ["joint 'hinge'", "child link 'amr'", "did you mean 'arm'", "arm, base"],
    ),
    "zero axis": (changed("0 0 1", "0 0 0"), ["joint 'hinge'", "<axis>", "non-zero"]),
    "short axis": (changed("0 0 1", "0 1"), ["joint 'hinge'", "2 numbers", "not 3"]),
    "number with underscore": (changed("-1", "-1_0"), ["<limit> lower", "'-1_0'"]),
    "NaN limit": (changed('upper="1"', 'upper="nan"'), ["<limit> upper", "NaN"]),
    "infinite origin": (changed("<axis", '<origin xyz="0 inf 0"/><axis'), ["joint 'hinge'", "<origin> xyz", "finite"]),
    "no mass element": (changed('<mass value="2"/>', ""), ["link 'arm'", "has no mass"]),
    "moving link without inertia": (WITHOUT, ["link 'arm'", "joint 'hinge'", "add an <inertial>"]),
    "massless but inert": (changed('"2"', '"0"'), ["link 'arm'", "mass is zero", "has no mass"]),
    "infinite damping": (
        changed("<limit ", '<dynamics damping="inf"/><limit '),
        ["joint 'hinge'", "<dynamics> damping is inf", "finite number"],
    ),
    "two parents": (
        with_joint("second", "base", "arm"), ["link 'arm' has two parents", "'hinge'", "'second'", "remove one"],
    ),
    "loop beside the tree": (
        with_joint("1", "a", "b", '<link name="a"/><link name="b"/>').replace("</robot>", JOINT.format("2", "b", "a")),
        ["'a' <- 'b' <- 'a'", "remove one of its joints"],
    ),
    "two parts": (
        changed('<link name="base"/>', '<link name="base"/><link name="stray"/>'),
        ["2 separate parts", "'base', 'stray'", "connect them"],
    ),
}  # fmt: skip
IMPOSSIBLE = {
    "no inertia element": (re.sub("<inertia .*/>", "", SMALL), ["'arm'", "no <inertia>"]),
    "negative mass": (changed('"2"', '"-2"'), ["link 'arm'", "-2 kg is negative"]),
    "absurd mass": (changed('"2"', '"1e308"'), ["link 'arm'", "above 1e+09 kg"]),
    "triangle inequality": (
        changed('ixx="0.1"', 'ixx="0.21"'),
        ["link 'arm'", "0.1, 0.1, 0.21", "triangle inequality", "Correct its <inertial>"],
    ),
    "all mass on the joint axis": (
        re.sub("<inertia .*/>", ROD, changed("0.1 0 0", "0 0 0.3")),
        ["link 'arm'", "joint 'hinge'", "no rotational inertia", "`armature`"],
    ),
}


@pytest.mark.parametrize("case", [*WRONG, *IMPOSSIBLE])
def test_each_error_names_file_culprit_and_remedy(case, tmp_path):
    text, fragments = (WRONG | IMPOSSIBLE)[case]
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    with pytest.raises(errors.RobotModelError) as caught:
        Robot.from_urdf(path)
    assert type(caught.value) is (errors.NonPhysicalInertia if case in IMPOSSIBLE else errors.RobotModelError)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    for fragment in fragments:
        assert fragment in message
    assert "\n" not in message


def test_expanding_entities_costs_nothing():
    laughs = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 12))
    with pytest.raises(errors.RobotModelError):
        Robot.from_urdf_text(f'<!DOCTYPE r [<!ENTITY l0 "ha">{laughs}]><robot name="&l11;"/>')


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(errors.RobotModelError, match=r"missing\.urdf: no such file; give the path"):
        Robot.from_urdf(tmp_path / "missing.urdf")
    (tmp_path / "arm.urdf").write_text(SMALL)
    with pytest.raises(errors.RobotModelError, match=r"is a directory; .* It holds arm\.urdf"):
        Robot.from_urdf(str(tmp_path))
    (tmp_path / "arm.urdf").write_bytes(SMALL.replace("small", "größe").encode("latin-1"))
    with pytest.raises(errors.RobotModelError, match=r"arm\.urdf: is not UTF-8 text; save the robot file as UTF-8"):
        Robot.from_urdf(tmp_path / "arm.urdf")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_names_in_any_letters_are_read_and_written(encoding, tmp_path):
    path, copy = tmp_path / "arm.urdf", tmp_path / "copy.urdf"
    path.write_bytes(('<?xml version="1.0" encoding="utf-8"?>\n' + SMALL.replace("small", "größe")).encode(encoding))
    robot = Robot.from_urdf(path)
    assert robot.name == "größe"
    robot.to_urdf(copy)
    assert copy.read_bytes() == path.read_bytes()


def test_rounding_of_an_ideal_plate_is_forgiven():
    plate = SMALL.replace('ixx="0.1"', 'ixx="0.0333333"').replace('iyy="0.1"', 'iyy="0.0666667"')
    assert Robot.from_urdf_text(plate).nv == 1
    with pytest.raises(errors.NonPhysicalInertia):
        Robot.from_urdf_text(plate.replace('"0.0666667"', '"0.0666666"'))


def test_a_rod_turns_about_another_axis_slides_along_its_own_or_has_a_rotor():
    rod, q = re.sub("<inertia .*/>", ROD, changed("0.1 0 0", "0 0 0.3")), torch.zeros(1, dtype=torch.float64)
    across = Robot.from_urdf_text(rod.replace('<axis xyz="0 0 1"/>', '<axis xyz="1 0 0"/>'))
    assert across.mass_matrix(q).item() == pytest.approx(0.1 + 2 * 0.3**2)
    assert Robot.from_urdf_text(rod.replace("revolute", "prismatic")).mass_matrix(q).item() == pytest.approx(2.0)
    assert Robot.from_urdf_text(rod, armature={"hinge": 0.02}).mass_matrix(q).item() == pytest.approx(0.02)


def test_files_that_are_too_large_or_too_deep_are_refused_at_once(tmp_path):
    with (tmp_path / "large.urdf").open("wb") as file:
        file.truncate(100 << 20)
    with pytest.raises(errors.RobotModelError, match=r"large\.urdf: holds 100 MiB, more than the 16 MiB"):
        Robot.from_urdf(tmp_path / "large.urdf")
    nested = "<robot name='r'>" + "<a>" * 10**6 + "</a>" * 10**6 + "</robot>"
    links = "<robot name='r'>" + "".join(f"<link name='{k}'/>" for k in range(10**6)) + "</robot>"
    for text in (nested, links):
        with pytest.raises(errors.RobotModelError, match="more than 200000 tags"):
            Robot.from_urdf_text(text)
    assert Robot.from_urdf_text(SMALL.replace("</robot>", "<a>" * 90_000 + "</a>" * 90_000 + "</robot>")).nv == 1
    chain = "".join(
        f'<link name="{k}"/><joint name="{k}" type="prismatic"><parent link="{k}"/><child link="{k + 1}"/></joint>'
        for k in range(1, 1002)
    )
    chain += '<link name="1002"/>' + JOINT.format("last", "arm", "1")
    with pytest.raises(errors.RobotModelError, match="1002 joints move; forcegp takes up to 1000"):
        Robot.from_urdf_text(SMALL.replace("</robot>", chain))


def test_a_pipe_is_refused_at_once(tmp_path):
    """To open it would wait for a writer for ever."""
    os.mkfifo(tmp_path / "pipe.urdf")
    with pytest.raises(errors.RobotModelError, match=r"pipe\.urdf: is not a regular file"):
        Robot.from_urdf(tmp_path / "pipe.urdf")


def test_massless_links_are_taken_where_what_they_carry_resists():
    """Three joints in one point, as models of people have them, and a tip that nothing resists."""
    turn = '<joint name="{0}" type="continuous"><parent link="{1}"/><child link="{2}"/><axis xyz="{3}"/></joint>'
    turns = turn.format("first", "base", "x", "1 0 0") + turn.format("second", "x", "y", "0 1 0")
    ball = SMALL.replace('<parent link="base"/>', '<parent link="y"/>').replace(
        "</robot>", f'<link name="x"/><link name="y"/>{turns}</robot>'
    )
    robot = Robot.from_urdf_text(ball)
    oracle = Oracle(ball, robot)
    q, v, tau = np.random.default_rng(3).normal(size=(3, 3))
    ours = robot.forward_dynamics(*(torch.tensor(x) for x in (q, v, tau)))
    np.testing.assert_allclose(ours, oracle.forward_dynamics(q, v, tau), rtol=1e-9)
    locked = torch.tensor([0.0, np.pi / 2, 0.0], dtype=torch.float64)  # the first and the last axis are one
    assert torch.linalg.eigvalsh(robot.mass_matrix(locked))[0] < 1e-15
    tip = ball.replace("</robot>", '<link name="tip"/>' + turn.format("spin", "arm", "tip", "0 0 1") + "</robot>")
    with pytest.raises(errors.RobotModelError, match="link 'tip' moves with joint 'spin'") as caught:
        Robot.from_urdf_text(tip)
    assert caught.value.remedy == {"locked": {"spin": 0.0}}
    assert thickened(robot)[0].joint_names == robot.joint_names
