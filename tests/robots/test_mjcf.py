"""MJCF files against MuJoCo: the same mass matrix, forces and frames at the same states, and what is left out."""

import warnings
from importlib.util import find_spec
from pathlib import Path

import mujoco as untyped
import numpy as np
import pytest
import torch
from tests.robots.mjcf_models import ALL, ARM, CHAIN, GRIPPER, OPEN_BARS, QUADRUPED
from tests.robots.mujoco_oracle import MujocoOracle, compiled, states
from tests.robots.random_positions import random_positions
from tests.robots.test_moving_bases import LIMBS

from forcegp import Model, Robot
from forcegp.errors import RobotFileWarning, RobotModelError

mujoco = untyped
FOLLOWERS = {"gripper": {"right": ("left", -1.5, np.radians(10) + 0.02)}}


def read(text, **options):
    with warnings.catch_warnings(action="ignore", category=RobotFileWarning):
        return Robot.from_mjcf_text(text, **options)


def same_dynamics(robot, oracle, rtol=1e-9):
    for q, v, a in zip(*states(robot), strict=True):
        oracle.at(q.numpy(), v.numpy())
        M, tau = oracle.mass_matrix(), oracle.inverse_dynamics(a.numpy())
        np.testing.assert_allclose(robot.mass_matrix(q), M, rtol=rtol, atol=rtol * abs(M).max())
        np.testing.assert_allclose(robot.inverse_dynamics(q, v, a), tau, rtol=rtol, atol=rtol * abs(tau).max())
        for body in range(1, oracle.model.nbody):
            pose = robot.frame_pose(q, oracle.model.body(body).name or f"body_{body}")
            np.testing.assert_allclose(pose[:3, 3], oracle.data.xpos[body], atol=1e-12)
            np.testing.assert_allclose(pose[:3, :3].flatten(), oracle.data.xmat[body], atol=1e-12)


@pytest.mark.parametrize("name", ALL)
def test_masses_forces_and_frames_are_those_of_mujoco(name):
    same_dynamics(read(ALL[name]), MujocoOracle(compiled(ALL[name]), FOLLOWERS.get(name)))


ASSETS = Path(find_spec("gymnasium").submodule_search_locations[0]) / "envs" / "mujoco" / "assets"


@pytest.mark.parametrize("path", sorted(ASSETS.glob("*.xml")), ids=lambda path: path.stem)
def test_published_files_are_those_of_mujoco(path):
    with warnings.catch_warnings(action="ignore"):  # what is left out, and an attribute that MuJoCo is about to drop
        robot, model = Robot.from_mjcf(path), mujoco.MjSpec.from_file(str(path)).compile()
    model.opt.density = model.opt.viscosity = 0.0
    same_dynamics(robot, MujocoOracle(model))


@pytest.mark.parametrize("name", ALL)
def test_stored_robots_and_urdf_files_are_the_same_robot(name, tmp_path):
    robot = read(ALL[name])
    with warnings.catch_warnings(action="ignore", category=RobotFileWarning):
        robot.to_urdf(tmp_path / "same.urdf")
    q, v, a = states(robot)
    options = {"gravity": robot.gravity}
    for other in (Robot.from_stored(robot.to_stored()), Robot.from_urdf(tmp_path / "same.urdf", **options)):
        assert (other.joint_names, other.base) == (robot.joint_names, robot.base)
        torch.testing.assert_close(other.inverse_dynamics(q, v, a), robot.inverse_dynamics(q, v, a), rtol=0.0, atol=0.0)


def test_limits_names_and_losses():
    arm = Robot.from_mjcf_text(ARM)
    assert arm.joint_names == ("shoulder", "roll", "elbow", "body_4_slide")
    assert [joint.effort_limit for joint in arm.joints] == [50.0, 8.0, 20.0, np.inf]
    assert [joint.friction for joint in arm.joints] == [0.0, 0.3, 0.3, 0.0]
    assert (arm.armature.tolist(), arm.gravity.tolist()) == ([0.1, 0.02, 0.02, 0.1], [0.0, 0.5, -9.7])
    assert (arm.joints[0].lower, arm.joints[0].upper) == pytest.approx((-np.pi / 2, np.radians(80.0)))
    assert arm.joint("roll").type == "continuous"
    assert "elbow site" in arm.link_names
    assert arm.base == "fixed"
    assert Robot.from_mjcf_text(CHAIN).base == "fixed"
    dog = Robot.from_mjcf_text(QUADRUPED)
    assert (dog.base, dog.position_names[:3]) == ("floating", ("trunk_free.x", "trunk_free.y", "trunk_free.z"))


HINGE = '<mujoco><worldbody><body name="a"><joint name="j" {0}/>{1}</body></worldbody>{2}</mujoco>'
BALL = '<geom size=".1"/>'
LOSSES = {
    "springs (Model.from_mjcf has them) (1)": ('stiffness="2"', BALL, ""),
    "tendons (1)": ("", BALL, '<tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>'),
    "laws of actuators (u holds joint forces) (1)": (
        "", BALL, '<actuator><position name="servo" joint="j" kp="3"/></actuator>',
    ),
    "forces of a medium (1)": ("", BALL, '<option viscosity="1"/>'),
    "compensation of gravity (1)": ("", BALL + '<body name="b" gravcomp="1"><geom size=".1"/></body>', ""),
    "couplings of joints that are not linear (equality 0)": (
        "", BALL + '<body name="b"><joint name="k"/><geom size=".1"/></body>',
        '<equality><joint joint1="j" joint2="k" polycoef="0 1 1 0 0"/></equality>',
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", LOSSES)
def test_what_acts_in_mujoco_alone_is_named(what):
    text = HINGE.format(*LOSSES[what])
    with pytest.warns(RobotFileWarning) as caught:
        Robot.from_mjcf_text(text)
    assert f"left out: {what}" in str(caught[0].message)


@pytest.mark.parametrize("tag", ["connect", "weld"])
@pytest.mark.parametrize("ends", ["body", "site"])
def test_closed_loops_are_refused_until_their_joints_are_locked(tag, ends):
    """As a tree such a mechanism would have motions that it has not."""
    anchor = ' anchor=".4 0 .05"' if (tag, ends) == ("connect", "body") else ""
    equality = f'<equality><{tag} name="pin" {ends}1="coupler" {ends}2="rocker"{anchor}{{}}/></equality></mujoco>'
    bars = OPEN_BARS
    for name in ("coupler", "rocker") if ends == "site" else ():
        bars = bars.replace(f'<joint name="{name}"', f'<site name="{name}"/><joint name="{name}"')
    text = bars.replace("</mujoco>", equality)
    with pytest.raises(RobotModelError, match="pin closes a loop, from link 'coupler' to 'rocker'") as caught:
        Robot.from_mjcf_text(text.format(""), locked={"rocker": 0.0})
    assert "Lock the joints between these links (crank, coupler)" in str(caught.value)
    beside = text.format("").replace("</worldbody>", f'<body name="free"><joint name="free"/>{BALL}</body></worldbody>')
    still = Robot.from_mjcf_text(beside, locked={"rocker": 0.0, "crank": 0.0, "coupler": 0.0})
    assert still.joint_names == ("free",)
    assert Robot.from_mjcf_text(text.format(' active="false"')).nv == 3
    if ends == "body":
        held = text.format("").replace(f'{ends}2="rocker"', f'{ends}2="hand"')
        held = held.replace("<worldbody>", '<worldbody><body name="hand" mocap="true"/>')
        with pytest.warns(RobotFileWarning, match="left out: motions from outside"):
            assert Robot.from_mjcf_text(held).nv == 3


def test_a_joint_that_an_equality_holds_is_locked():
    text = HINGE.format('ref="0.2"', BALL + '<body name="b"><joint name="k"/><geom size=".1"/></body>', "")
    text = text.replace("</mujoco>", '<equality><joint joint1="j" polycoef="0.3 0 0 0 0"/></equality></mujoco>')
    robot = Robot.from_mjcf_text(text.replace('ref="0.2"', 'ref="0.2" armature="5"'))
    assert robot.locked == pytest.approx({"j": 0.2 * np.pi / 180.0 + 0.3})
    assert robot.joint_names == ("k",)


def test_rotor_inertias_of_actuators_count():
    text = HINGE.format('armature=".3"', BALL, '<actuator><motor joint="j" gear="3" armature=".2"/></actuator>')
    assert Robot.from_mjcf_text(text).armature.item() == pytest.approx(0.3 + 9 * 0.2)
    same_dynamics(Robot.from_mjcf_text(text), MujocoOracle(compiled(text)))


BAD = {
    "no XML": ("<mujoco", "not well-formed"),
    "entities": ('<!DOCTYPE m [<!ENTITY a "b">]><mujoco/>', "DTD"),
    "schema": ('<mujoco><worldbody><joint what="1"/></worldbody></mujoco>', "MuJoCo refuses it"),
    "no mass": (HINGE.format("", "", ""), "mass and inertia"),
    "a ball joint": (HINGE.format('type="ball"', BALL, ""), "three hinges"),
    "no file": ('<mujoco><include file="other.xml"/></mujoco>', "other.xml"),
    "mesh": (
        HINGE.format("", '<geom type="mesh" mesh="m"/>', '<asset><mesh name="m" file="m.stl"/></asset>'),
        "the mass of a comes from meshes",
    ),
    "still": (f"<mujoco><worldbody>{BALL}</worldbody></mujoco>", "no movable joint"),
}


@pytest.mark.parametrize("case", BAD)
def test_files_that_cannot_be_taken_are_refused_in_one_line(case, tmp_path):
    text, message = BAD[case]
    (tmp_path / "bad.xml").write_text(text)
    with pytest.raises(RobotModelError, match=message) as caught:
        Robot.from_mjcf(tmp_path / "bad.xml")
    assert "\n" not in str(caught.value)
    assert str(tmp_path / "bad.xml") in str(caught.value)


def test_files_include_others_and_are_found_by_their_root_element(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "arm.mjcf").write_text(
        '<?xml version="1.0"?><!-- <robot> --><mujoco><include file="parts/one.xml"/></mujoco>'
    )
    (tmp_path / "parts" / "one.xml").write_text(GRIPPER)
    robot = Robot.from_file(tmp_path / "arm.mjcf")
    torch.testing.assert_close(robot.mass_matrix(robot.neutral()), read(GRIPPER).mass_matrix(robot.neutral()))
    (tmp_path / "arm.xml").write_text(read(CHAIN).urdf_text)
    assert Robot.from_file(tmp_path / "arm.xml").nv == 4
    with pytest.raises(RobotModelError, match="from_mjcf reads"):
        Robot.from_urdf(tmp_path / "arm.mjcf")


def written(robot):
    with warnings.catch_warnings(action="ignore", category=RobotFileWarning):
        return robot.to_mjcf()


def followers(robot):
    return {
        body.name: (robot.joint_names[drive.joint], drive.multiplier, drive.offset)
        for body, drive in zip(robot.layout.bodies, robot.layout.drives, strict=True)
        if body.name not in robot.joint_names
    }


@pytest.mark.parametrize("name", ALL)
def test_mujoco_and_forcegp_read_the_same_robot(name, tmp_path):
    robot = read(ALL[name])
    text = written(robot)
    same_dynamics(robot, MujocoOracle(mujoco.MjModel.from_xml_string(text), followers(robot)))
    again = Robot.from_mjcf_text(text)
    assert (again.joint_names, again.base, again.name) == (robot.joint_names, robot.base, robot.name)
    q, v, a = states(robot)
    torch.testing.assert_close(again.inverse_dynamics(q, v, a), robot.inverse_dynamics(q, v, a), rtol=1e-11, atol=1e-11)
    for joint, other in zip(robot.joints, again.joints, strict=True):
        numbers = [(x.lower, x.upper, x.effort_limit, x.damping, x.friction) for x in (joint, other)]
        assert numbers[0] == pytest.approx(numbers[1], rel=1e-12)
    assert set(again.link_names) >= {x for x in robot.link_names if robot.link(x).mass}
    torch.testing.assert_close(again.armature, robot.armature)


@pytest.mark.parametrize("options", [{"base": "floating"}, {"base": "fixed"}])
def test_bases_and_locked_joints(options):
    robot = Robot.from_urdf_text(LIMBS, locked={"a_knee": 0.3}, armature={"b_slide": 0.2}, **options)
    again = Robot.from_mjcf_text(written(robot))
    assert again.joint_names == robot.joint_names
    q, v, a = states(robot)
    torch.testing.assert_close(again.inverse_dynamics(q, v, a), robot.inverse_dynamics(q, v, a), rtol=1e-11, atol=1e-11)


def test_rods_and_points_and_last_links_without_mass(tmp_path):
    text = """<robot name="rod"><link name="base"/><joint name="j" type="revolute"><parent link="base"/>
    <child link="rod"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="2" velocity="3"/></joint>
    <link name="rod"><inertial><origin xyz="0 0 .5"/><mass value="2"/>
    <inertia ixx="{0}" iyy="{0}" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
    for moment in (0.0, 0.3):
        Robot.from_urdf_text(text.format(moment)).to_mjcf(tmp_path / "rod.xml")
        again = Robot.from_file(tmp_path / "rod.xml")
        assert again.mass_matrix(torch.zeros(1).double()).item() == pytest.approx(0.5 + moment, rel=1e-12)
    bare = text.format(0.3).replace('value="2"', 'value="0"').replace('"0.3"', '"0"')
    with pytest.raises(RobotModelError, match="give it a mass"):
        Robot.from_urdf_text(bare, armature={"j": 1.0}).to_mjcf(tmp_path / "none.xml")
    assert not (tmp_path / "none.xml").exists()


@pytest.mark.parametrize("gear", ["0 0 1 0 0 .02", "1 2 -3 .4 .5 .6", "0 0 0 .1 .2 -.3", "0 0 0 0 0 0"])
@pytest.mark.parametrize("base", ["", '<freejoint name="root"/>'])
def test_rotors_on_links_that_move_are_inputs(tmp_path, base, gear):
    """MuJoCo's joint forces: a tilting pod with a rotor under a frame of its own, and one on the body."""
    pod = '<body name="pod" pos=".2 0 .1" euler="10 0 20"><joint name="tilt" axis="0 1 0" pos="0 .01 .02"/>'
    pod += '<geom size=".05" mass=".3"/><body pos=".05 .02 .1" euler="30 -20 5"><site name="r2" pos="0 .1 .02"/></body>'
    right = '<motor name="right" site="r1" gear="0 0 1 0 0 .1"/>' if base else ""
    text = (
        f'<mujoco><worldbody><body name="frame">{base}<geom size=".1 .2 .1" type="box"/><site name="r1" pos=".1 .1 0"/>'
        f'{pod}</body></body></worldbody><actuator><motor name="left" site="r2" gear="{gear}"/>'
        f'<motor name="turn" joint="tilt" gear="3"/>{right}</actuator></mujoco>'
    )
    with warnings.catch_warnings(action="error"):
        (tmp_path / "rotors.xml").write_text(text)
        model, plain = Model.from_mjcf(tmp_path / "rotors.xml"), mujoco.MjModel.from_xml_string(text)
    names = ("turn", *(("right",) if base else ()), "left")
    assert model.inputs == names
    oracle, generator = MujocoOracle(plain), torch.Generator().manual_seed(0)
    q = random_positions(model.robot, generator, 3)
    v, u = (torch.randn(3, n, dtype=torch.float64, generator=generator) for n in (model.robot.nv, len(names)))
    delivered = model.state(q, v, u).delivered
    for k in range(3):
        oracle.data.ctrl[[plain.actuator(name).id for name in names]] = u[k].numpy()
        oracle.at(q[k].numpy(), v[k].numpy())
        np.testing.assert_allclose(delivered[k], oracle.T.T @ oracle.data.qfrc_actuator, atol=1e-9)
    assert Model.from_json(model.to_json()).inputs == names
    if base:
        assert Model.from_mjcf(tmp_path / "rotors.xml", locked={"tilt": 0.3}).inputs == ("right", "left")
