"""What is written into a URDF, and what is expanded to one."""

import math
import sys
from xml.etree import ElementTree

import numpy as np
import pinocchio
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tests.robots.pinocchio_oracle import Oracle
from tests.robots.robot_models import CHAIN, MODELS, loaded
from tests.robots.test_mimic import CHAIN_MIMICS, with_mimics
from tests.robots.test_urdf_errors import SMALL

from forcegp.errors import LARGEST, MissingExtra, NonPhysicalInertia, RobotFileWarning, RobotModelError, UnknownName
from forcegp.model import Model
from forcegp.robots import Robot
from forcegp.robots.inertia import physical_objection
from forcegp.robots.urdf_file import MARGIN, nearest_inertia, replace_dynamics, replace_inertial


def test_rotor_inertias_are_written_and_read_back(tmp_path):
    robot, path = Robot.from_urdf_text(CHAIN, armature={"spin": 0.1, "tilt": 1 / 3}), tmp_path / "chain.urdf"
    with pytest.warns(RobotFileWarning, match="^chain.urdf: only forcegp reads rotor inertias .* of spin, tilt"):
        text = robot.to_urdf(path)
    again = Robot.from_urdf(path)
    assert again.armature.equal(robot.armature)
    assert Robot.from_urdf(path, armature={"spin": 0.2}).armature.tolist() == [0.0, 0.2, 0.0, 0.0]
    with pytest.warns(RobotFileWarning):
        assert again.to_urdf(path) == text
    robot.with_armature([0.0] * 4).to_urdf(path)
    assert Robot.from_urdf(path).armature.tolist() == [0.0] * 4


def test_rotors_of_joints_that_follow_count_by_the_square_of_their_ratio():
    rotors = replace_dynamics(CHAIN, {"slide": {"armature": 5.0}}, source="a test")
    robot = Robot.from_urdf_text(with_mimics(rotors, CHAIN_MIMICS))  # slide = 0.4 tilt + 0.1
    assert robot.armature.tolist() == pytest.approx([5 * 0.4**2 if name == "tilt" else 0 for name in robot.joint_names])
    changed = robot.with_armature({"tilt": 2.0})  # those that follow have none of their own then
    assert changed.armature.tolist() == [2.0 if name == "tilt" else 0.0 for name in robot.joint_names]


def test_without_rotors_nothing_is_in_the_file(tmp_path):
    assert Robot.from_urdf_text(CHAIN).to_urdf(tmp_path / "chain.urdf") == CHAIN


MACRO = SMALL.replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ').replace(
    '<mass value="2"/>', '<xacro:property name="m" value="${1 + 1}"/><mass value="${m}"/>'
)


def test_xacro_files_need_the_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "xacro", None)
    (tmp_path / "arm.xacro").write_text(MACRO)
    with pytest.raises(MissingExtra, match=r"arm\.xacro: .*pip install 'forcegp\[xacro\]'"):
        Robot.from_urdf(tmp_path / "arm.xacro")


@pytest.mark.parametrize("name", ["arm.xacro", "arm.urdf.xacro"])
def test_xacro_files_are_expanded(tmp_path, name):
    pytest.importorskip("xacro")
    (tmp_path / name).write_text(MACRO)
    assert Robot.from_urdf(tmp_path / name).link("arm").mass == 2.0
    (tmp_path / name).write_text(MACRO.replace("1 + 1", "1 / 0"))
    with pytest.raises(RobotModelError, match="xacro could not expand it"):
        Robot.from_urdf(tmp_path / name)


@pytest.mark.parametrize("model", MODELS)
def test_written_urdf_moves_as_the_numbers_say(model, tmp_path):
    robot = Robot.from_urdf_text(MODELS[model]())
    names = [n for n in robot.layout.moving if robot.link(n).mass > 0]
    given = loaded(robot, *names)
    q, v = torch.tensor(np.random.default_rng(1).normal(size=(2, robot.nv)))
    path = tmp_path / "identified.urdf"
    text = given.to_urdf(path)
    assert path.read_text(encoding="utf-8") == text
    assert [entry.name for entry in tmp_path.iterdir()] == ["identified.urdf"]  # no temporary file left
    again = Robot.from_urdf(path)
    links = [[*map(each.link, names)] for each in (robot, given, again)]
    numbers = [[(x.mass, *x.center_of_mass, *x.inertia.flat) for x in own] for own in links]
    assert numbers[0] != numbers[1] == numbers[2]
    mass, bias = again.mass_matrix_and_bias(q, v)
    oracle = Oracle(text, again)
    np.testing.assert_allclose(oracle.mass_matrix(q.numpy()), mass, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(oracle.bias_forces(q.numpy(), v.numpy()), bias, rtol=1e-10, atol=1e-11)


TEXT = """<?xml version='1.0'?><!-- Größe --><robot name="r" xmlns:x="x"><link name="a"/><link  name='b'/>
  <!-- kept --><gazebo><joint name="one"/></gazebo><x:macro name="m"/>
  <joint name="one" type="revolute"><parent link="a"/><child link="b"/>%s</joint></robot>"""


@pytest.mark.parametrize("before", ["", '<dynamics friction="1"/>', "<dynamics damping = '3' x=\"7\"/>"])
def test_inertials_and_dynamics_are_replaced_or_added_and_the_rest_stays(before):
    written = replace_dynamics(TEXT % before, {"one": {"damping": 0.1, "friction": 0.25}}, source="a test")
    element = ElementTree.fromstring(written).find("joint/dynamics")
    assert {**element.attrib, "x": "7"} == {"damping": "0.1", "friction": "0.25", "x": "7"}
    parts = "<!-- Größe -->", "<!-- kept -->", "<x:macro", '<gazebo><joint name="one"/>'
    assert all(part in written for part in parts)
    for _ in range(2):
        written = replace_inertial(written, "b", 2.0, np.zeros(3), np.eye(3), source="a test")
    assert Robot.from_urdf_text(written).mass == 2.0
    with pytest.raises(UnknownName, match="a test: no joint 'two'"):
        replace_dynamics(TEXT % "", {"two": {"damping": 0.1}}, source="a test")


URDF = """<robot name="one"><link name="base"/>
<!-- rounded to death --><link name="arm"><inertial><origin xyz="0 0 0.1"/><mass value="{mass}"/>
<inertia ixx="{ixx}" iyy="0.02" izz="0.01" ixy="0.001" ixz="0" iyz="0"/></inertial></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
BROKEN = URDF.format(mass=1.0, ixx=0.04)


@given(st.integers(0, 10_000))
def test_the_nearest_is_possible_and_no_possible_one_is_nearer(seed):
    half, root = (np.random.default_rng(each).normal(size=(3, 3)) for each in (seed, seed + 1))
    inertia = half + half.T + np.eye(3)
    nearest = nearest_inertia(inertia)
    assert physical_objection(1.0, np.zeros(3), nearest) is None
    # the optimality condition of a projection onto a convex set, whatever the axes of the other point
    before, after = (0.5 * np.trace(x) * np.eye(3) - x for x in (inertia, nearest))
    least = MARGIN * np.maximum(np.linalg.eigvalsh(before), 0.0).sum()
    assert np.linalg.eigvalsh(after)[0] > (1.0 - 1e-9) * least
    assert np.sum((before - after) * (root @ root.T + least * np.eye(3) - after)) < 1e-8


def test_the_repaired_robot_says_so_and_can_be_stored():
    with pytest.warns(RobotFileWarning, match=r"link 'arm'.*triangle.* \d+(\.\d+)? %"):
        robot = Robot.from_urdf_text(BROKEN, inertias="nearest")
    assert "<!-- rounded to death -->" in robot.to_urdf()
    again, q = Model.from_json(Model(robot).to_json()).robot, torch.zeros(1).double()
    assert again.mass_matrix(q).equal(robot.mass_matrix(q))


def test_a_frame_without_mass_loses_its_inertia():
    frame = """<link name="tip"><inertial><mass value="0"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
    </inertial></link><joint name="hold" type="fixed"><parent link="arm"/><child link="tip"/></joint></robot>"""
    text = URDF.format(mass=1.0, ixx=0.02).replace("</robot>", frame)
    with pytest.raises(NonPhysicalInertia, match="'tip'") as caught:
        Robot.from_urdf_text(text)
    assert caught.value.remedy == {"inertias": "nearest"}
    with pytest.warns(RobotFileWarning, match=r"'tip'.* changed by 1e\+02 %"):
        robot = Robot.from_urdf_text(text, **caught.value.remedy)
    plain, q = Robot.from_urdf_text(URDF.format(mass=1.0, ixx=0.02)), torch.zeros(1).double()
    assert robot.mass_matrix(q).equal(plain.mass_matrix(q))


@pytest.mark.parametrize(("mass", "why"), [(-1.0, "negative"), (math.inf, "not finite")])
def test_an_impossible_mass_is_not_mended(mass, why):
    with pytest.raises(NonPhysicalInertia, match=why):
        Robot.from_urdf_text(URDF.format(mass=mass, ixx=0.02), inertias="nearest")


def test_written_files_have_the_limits_without_which_others_refuse_them(tmp_path):
    """Of joints for which the file states none or half of them: urdfdom, by which Pinocchio reads, needs all."""
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    link = f'<link name="{{}}"><inertial><mass value="1"/>{inertia}</inertial></link>'
    joint = '<joint name="j{0}" type="{1}"><parent link="l{0}"/><child link="l{2}"/><axis xyz="0 1 0"/>{3}</joint>'
    kinds = [("revolute", ""), ("revolute", '<limit lower="-1" upper="2"/>'), ("prismatic", '<limit effort="5"/>')]
    text = "".join(link.format(f"l{k}") for k in range(4))
    text += "".join(joint.format(k, kind, k + 1, limit) for k, (kind, limit) in enumerate(kinds))
    robot = Robot.from_urdf_text(f'<robot name="r">{text}</robot>')
    with pytest.raises(ValueError, match=r"."):
        pinocchio.buildModelFromXML(robot.urdf_text)
    robot.to_urdf(tmp_path / "r.urdf")
    model, again = pinocchio.buildModelFromUrdf(str(tmp_path / "r.urdf")), Robot.from_urdf(tmp_path / "r.urdf")
    assert model.upperPositionLimit.tolist() == [LARGEST, 2.0, LARGEST]
    for one, other in zip(robot.joints, again.joints, strict=True):
        limits, written = ((x.lower, x.upper, x.velocity_limit, x.effort_limit) for x in (one, other))
        assert limits == written
    assert (again.joints[0].effort_limit, again.joints[2].effort_limit) == (math.inf, 5.0)


@pytest.mark.parametrize(
    ("place", "mass", "named"), [("0 0 9", 1.5e-9, False), ("0 0 11", 1.0, True), ("0 0 1", 5e-10, True)]
)
def test_lengths_in_millimetres_and_bodies_without_weight_are_named(place, mass, named, recwarn):
    inertia = '<inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/>'
    link = f'<link name="l"><inertial><mass value="{mass}"/>{inertia}</inertial></link><link name="base"/>'
    joint = f'<joint name="j" type="continuous"><origin xyz="{place}"/><parent link="base"/><child link="l"/></joint>'
    Robot.from_urdf_text(f'<robot name="r">{link}{joint}</robot>')
    told = " ".join(str(each.message) for each in recwarn)
    assert ("are lengths in metres? (origin of j)" in told or "are masses in kilograms? (l)" in told) == named
