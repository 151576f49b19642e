"""URDFs that between them hold every kind of joint and link, for tests of any package."""

from typing import Any

import numpy as np

from forcegp.robots import Robot
from forcegp.robots.inertia import physical_of_pseudo_inertia, pseudo_inertia
from forcegp.robots.urdf_file import replace_inertial
from forcegp.simulation import kuka_file

# Branches at two depths, joints scattered over the file, names not in alphabetical order, links fixed to moving links
# with inertias at turned origins, massless frames, a base that is offset from the root link.
TREE = """<?xml version="1.0"?>
<robot name="tree">
  <link name="world"/>
  <joint name="mount" type="fixed"><origin xyz="0.1 -0.2 0.3" rpy="0.3 -0.2 0.5"/><parent link="world"/>
    <child link="base"/></joint>
  <link name="base"><inertial><mass value="0"/><inertia ixx="1" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>
    </link>
  <joint name="right_wrist" type="revolute"><origin xyz="0.05 0.3 0" rpy="0 0 1.1"/><parent link="right_arm"/>
    <child link="right_hand"/><axis xyz="0 0 -1"/><limit lower="-1" upper="2" velocity="3" effort="40"/></joint>
  <joint name="torso" type="revolute"><origin xyz="0 0 0.4"/><parent link="base"/><child link="body"/>
    <axis xyz="0 1 0"/><limit effort="100" velocity="2"/><dynamics damping="0.7" friction="0.2"/></joint>
  <joint name="right_shoulder" type="continuous"><origin xyz="0 -0.2 0.3" rpy="-0.4 0.1 0"/><parent link="body"/>
    <child link="right_arm"/><axis xyz="1 2 -0.5"/></joint>
  <joint name="left_shoulder" type="revolute"><origin xyz="0 0.2 0.3" rpy="0.4 0 0"/><parent link="body"/>
    <child link="left_arm"/><limit effort="80" velocity="2" lower="-3" upper="3"/></joint>
  <joint name="left_gripper" type="prismatic"><origin xyz="0.3 0 0.1" rpy="0 0.7 0"/><parent link="left_arm"/>
    <child link="left_finger"/><axis xyz="0 1 1"/><limit lower="0" upper="0.05" velocity="0.1" effort="20"/></joint>
  <joint name="camera_mount" type="fixed"><origin xyz="0.1 0 0.2" rpy="0.2 0.3 -0.4"/><parent link="body"/>
    <child link="camera"/></joint>
  <joint name="camera_lens" type="fixed"><origin xyz="0.02 0 0" rpy="1 0 1"/><parent link="camera"/>
    <child link="lens"/></joint>
  <joint name="second_finger" type="prismatic"><origin xyz="0.3 0 -0.1" rpy="0 0.7 0.2"/><parent link="left_arm"/>
    <child link="a_finger"/><axis xyz="0 0 -2"/><limit effort="20" velocity="0.1" lower="-0.05"/></joint>
  <link name="body"><inertial><origin xyz="0.01 0.02 0.2" rpy="0.1 0.2 0.3"/><mass value="8"/>
    <inertia ixx="0.3" ixy="0.01" ixz="-0.02" iyy="0.25" iyz="0.03" izz="0.12"/></inertial></link>
  <link name="right_arm"><inertial><origin xyz="0 0.15 0"/><mass value="2.5"/>
    <inertia ixx="0.03" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.03"/></inertial></link>
  <link name="left_arm"><inertial><origin xyz="0.15 0 0.05" rpy="0 0 0.4"/><mass value="2.2"/>
    <inertia ixx="0.005" ixy="0.001" ixz="0" iyy="0.028" iyz="0" izz="0.027"/></inertial></link>
  <link name="right_hand"><inertial><origin xyz="0.01 0.02 0.03"/><mass value="0.6"/>
    <inertia ixx="0.001" ixy="0" ixz="0.0001" iyy="0.0012" iyz="0" izz="0.0008"/></inertial></link>
  <link name="left_finger"><inertial><origin xyz="0 0 0.02"/><mass value="0.1"/>
    <inertia ixx="0.0001" ixy="0" ixz="0" iyy="0.0001" iyz="0" izz="0.00005"/></inertial></link>
  <link name="a_finger"><inertial><origin xyz="0 0.01 0.02" rpy="0 1 0"/><mass value="0.12"/>
    <inertia ixx="0.0001" ixy="0.00001" ixz="0" iyy="0.00012" iyz="0" izz="0.00005"/></inertial></link>
  <link name="camera"><inertial><origin xyz="0.01 0 0" rpy="0.5 0 0"/><mass value="0.4"/>
    <inertia ixx="0.0004" ixy="0" ixz="0" iyy="0.0003" iyz="0.00005" izz="0.0002"/></inertial></link>
  <link name="lens"/>
</robot>
"""

# Prismatic, continuous, skew-axis, fixed and revolute joints in series, with axes that are not of unit length.
CHAIN = """<robot name="chain">
  <link name="rail"/>
  <joint name="slide" type="prismatic"><origin xyz="0.2 0.1 0.5" rpy="0.2 0 0.4"/><parent link="rail"/>
    <child link="cart"/><axis xyz="0.6 -0.2 0.3"/><limit lower="-2" upper="2" effort="300" velocity="1.5"/>
    <dynamics damping="3" friction="1.5"/></joint>
  <link name="cart"><inertial><origin xyz="0 0.1 0.02" rpy="0.2 -0.1 0.6"/><mass value="4"/>
    <inertia ixx="0.05" ixy="0.004" ixz="0.002" iyy="0.06" iyz="-0.003" izz="0.04"/></inertial></link>
  <joint name="spin" type="continuous"><origin xyz="0 0 0.1" rpy="0 0.2 0"/><parent link="cart"/><child link="hub"/>
    <axis xyz="0 0 1"/></joint>
  <link name="hub"><inertial><origin xyz="0.02 0 0"/><mass value="1.5"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.015"/></inertial></link>
  <joint name="flange" type="fixed"><origin xyz="0.1 0 0.05" rpy="0.5 0.4 0.3"/><parent link="hub"/>
    <child link="bracket"/></joint>
  <link name="bracket"><inertial><origin xyz="0.03 0.02 0.01" rpy="0 0 0.8"/><mass value="0.7"/>
    <inertia ixx="0.002" ixy="0.0002" ixz="0" iyy="0.003" iyz="0.0001" izz="0.0025"/></inertial></link>
  <joint name="skew" type="revolute"><origin xyz="0.05 0.2 0" rpy="-0.7 0.1 0.9"/><parent link="bracket"/>
    <child link="forearm"/><axis xyz="3 -2 1"/><limit lower="-2.5" upper="2.5" effort="60" velocity="4"/></joint>
  <link name="forearm"><inertial><origin xyz="0.2 0.01 0" rpy="0 0.3 0"/><mass value="1.2"/>
    <inertia ixx="0.002" ixy="0" ixz="0.0005" iyy="0.02" iyz="0" izz="0.021"/></inertial></link>
  <joint name="tilt" type="revolute"><origin xyz="0.4 0 0" rpy="0 0 1.2"/><parent link="forearm"/>
    <child link="wrist"/><axis xyz="-1 0 0"/><limit lower="-1.5" upper="1.5" effort="20" velocity="6"/></joint>
  <link name="wrist"><inertial><origin xyz="0 0.03 0.04"/><mass value="0.5"/>
    <inertia ixx="0.0009" ixy="0" ixz="0" iyy="0.0008" iyz="0.0001" izz="0.0007"/></inertial></link>
  <joint name="tip" type="fixed"><origin xyz="0 0.05 0.1" rpy="0.1 0.2 0.3"/><parent link="wrist"/>
    <child link="tool"/></joint>
  <link name="tool"/>
</robot>
"""


def iiwa() -> str:
    """The KUKA LBR iiwa with meshes."""
    return kuka_file().read_text(encoding="utf-8")


MODELS = {"iiwa": iiwa, "tree": lambda: TREE, "chain": lambda: CHAIN}
FRAMES = {"iiwa": "lbr_iiwa_link_7", "tree": "right_hand", "chain": "tool"}  # a frame at the end of each


def with_link(robot: Robot, name: str, mass: float, center: Any, inertia: Any) -> Robot:
    """The robot whose link has these numbers in its file."""
    return robot.with_text(replace_inertial(robot.urdf_text, name, mass, center, inertia, source=robot.source))


def loaded(robot: Robot, *links: str, mass: float = 0.3) -> Robot:
    """The robot with other masses, centres and inertias of these links: each carries two more points."""
    for k, name in enumerate(links):
        link = robot.link(name)
        total = pseudo_inertia(link.mass, np.array(link.center_of_mass), np.array(link.inertia))
        for point in ((0.1, 0.05 + 0.01 * k, -0.02), (-0.04, 0.1, 0.07), (0.02, -0.03, 0.1)):
            total = total + pseudo_inertia(mass, np.array(point), np.diag([0.002, 0.003, 0.004]) * mass)
        robot = with_link(robot, name, *physical_of_pseudo_inertia(total))
    return robot
