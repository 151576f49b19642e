"""Two light links with dry friction: the robot as a model knows it, `NOMINAL`, and as it is, `TRUE`."""

import numpy as np

from forcegp import Model, RigidBodies, Robot, Stribeck
from forcegp.forces import Actuation

LINK = """<link name="{name}"><inertial><origin xyz="0.1 0 0"/><mass value="0.1"/>
<inertia ixx="0.003" iyy="0.003" izz="0.003" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="continuous"><origin xyz="{x} 0 0"/><parent link="{parent}"/>
<child link="{child}"/><axis xyz="0 1 0"/></joint>"""
URDF = '<robot name="two links"><link name="base"/>' + "".join(
    [
        LINK.format(name="upper"),
        LINK.format(name="fore"),
        JOINT.format(name="shoulder", x=0, parent="base", child="upper"),
        JOINT.format(name="elbow", x=0.2, parent="upper", child="fore"),
    ]
)
ROBOT = Robot.from_urdf_text(URDF + "</robot>")
NOMINAL = Model(ROBOT, (), (Actuation(), RigidBodies()))
FRICTION = Stribeck(level=0.1, breakaway=0.05, stribeck_velocity=0.1, velocity_scale=0.1)  # Nm, rad/s
TRUE = Model(ROBOT, (), (Actuation(), RigidBodies(), FRICTION))
HANGING, UPRIGHT = np.array([np.pi / 2, 0.0, 0.0, 0.0]), np.array([-np.pi / 2, 0.0, 0.0, 0.0])  # [q, v]
DT = 0.02  # s
LIMIT = 0.45  # Nm; gravity needs 0.39 Nm at the shoulder where the arm is level
