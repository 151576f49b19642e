"""Motions with known answers: the small arm of `tests.posterior.arm` on all surfaces, and damped oscillators."""

from forcegp.forces import Actuation, RigidBodies, Stribeck
from forcegp.mechanics import Contact, Plane, Sphere
from forcegp.model import Model
from forcegp.robots import Robot

TOOL = (0.0, 0.0, 0.2)
PLANE = Contact("hand", TOOL, Plane((0.2, 0.0, 1.0), 0.4))
CONTACTS = {
    "plane": (PLANE,),
    "plane twice": (PLANE, PLANE),
    "sphere": (Contact("hand", TOOL, Sphere((0.0, 0.1, 0.4), 0.45)),),
}


LIGHT_LINK = """<link name="{name}"><inertial><origin xyz="0.1 0 0"/><mass value="0.1"/>
<inertia ixx="0.003" iyy="0.003" izz="0.003" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
LIGHT_JOINT = """<joint name="{name}" type="revolute"><origin xyz="{x} 0 0"/><parent link="{parent}"/>
<child link="{child}"/><axis xyz="0 0 1"/><limit lower="-9" upper="9" effort="9" velocity="9"/></joint>"""


def light_arm() -> Model:
    """Two links of inertia .003 kg m^2 with dry friction that rises and falls within .1 rad/s: a stiff system."""
    urdf = [
        LIGHT_LINK.format(name="upper"),
        LIGHT_LINK.format(name="fore"),
        LIGHT_JOINT.format(name="shoulder", x=0, parent="base", child="upper"),
        LIGHT_JOINT.format(name="elbow", x=0.2, parent="upper", child="fore"),
    ]
    robot = Robot.from_urdf_text('<robot name="light"><link name="base"/>' + "".join(urdf) + "</robot>")
    stribeck = Stribeck(level=0.3, breakaway=0.1, stribeck_velocity=0.1, velocity_scale=0.1)
    return Model(robot, (), (Actuation(), RigidBodies(), stribeck))
