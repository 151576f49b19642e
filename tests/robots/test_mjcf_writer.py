"""MJCF that is written: MuJoCo has the same mass matrix and forces, and what is read back is the same robot."""

import warnings

import mujoco as untyped
import pytest
import torch
from tests.robots.mjcf_models import ALL
from tests.robots.mujoco_oracle import MujocoOracle, states
from tests.robots.test_mjcf import read, same_dynamics
from tests.robots.test_moving_bases import LIMBS

from forcegp import Robot
from forcegp.errors import RobotFileWarning, RobotModelError

mujoco = untyped


def written(robot):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RobotFileWarning)
        return robot.to_mjcf()


def followers(robot):
    drives = zip(robot.layout.bodies, robot.layout.drives, strict=True)
    return {
        body.name: (robot.joint_names[drive.joint], drive.multiplier, drive.offset)
        for body, drive in drives
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
        robot = Robot.from_urdf_text(text.format(moment))
        robot.to_mjcf(tmp_path / "rod.xml")
        again = Robot.from_file(tmp_path / "rod.xml")
        assert again.mass_matrix(torch.zeros(1).double()).item() == pytest.approx(0.5 + moment, rel=1e-12)
    bare = text.format(0.3).replace('value="2"', 'value="0"').replace('"0.3"', '"0"')
    with pytest.raises(RobotModelError, match="give it a mass"):
        Robot.from_urdf_text(bare, armature={"j": 1.0}).to_mjcf(tmp_path / "none.xml")
    assert not (tmp_path / "none.xml").exists()
