import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import torch
from tests.simulation.test_bullet import numbers, urdf

from forcegp.robots import Robot
from forcegp.simulation.kuka_surface import kuka_urdf
from forcegp.simulation.scenarios import KukaSurfaceConfig

pybullet_data = pytest.importorskip("pybullet_data")
ODD = {"tool_center_of_mass": (0.01, 0.0, 0.02), "joint_damping": 0.25, "base_height": 0.4}


def test_it_refers_to_no_file_and_keeps_the_licence():
    text = urdf()
    for word in ("filename", "mesh", "<visual", "<collision", "<material"):
        assert word not in text.partition("<robot")[2]
    assert "THIS SOFTWARE IS PROVIDED BY THE COPYRIGHT HOLDERS" in text
    assert "Changed by forcegp" in text


def test_tool_damping_and_base_are_the_ones_given():
    text = kuka_urdf(type("Odd", (KukaSurfaceConfig,), ODD)(tool_mass=3.5))
    tool = ElementTree.fromstring(text).find("link[@name='lbr_iiwa_link_7']/inertial")
    assert tool.find("mass").get("value") == "3.5"
    assert numbers(tool.find("origin")) == [0.01, 0.0, 0.02]
    moments = {name: float(value) for name, value in tool.find("inertia").items()}
    assert moments == {"ixx": 0.005, "iyy": 0.0036, "izz": 0.0047, "ixy": 0, "ixz": 0, "iyz": 0}
    robot = Robot.from_urdf_text(text)
    assert [joint.damping for joint in robot.joints] == [0.25] * 7
    base = robot.frame_pose(torch.zeros(7, dtype=torch.float64), "lbr_iiwa_link_0")
    assert base[:3, 3].tolist() == [0.0, 0.0, 0.4]


def test_joints_and_the_other_links_are_the_originals():
    original = Robot.from_urdf(Path(pybullet_data.getDataPath()) / "kuka_iiwa/model.urdf")
    changed = Robot.from_urdf_text(urdf(joint_damping=0.5))
    assert changed.joints == original.joints
    kept = [f"lbr_iiwa_link_{number}" for number in range(1, 7)]
    assert all(changed.link(name) == original.link(name) for name in kept)
