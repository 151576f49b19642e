"""Damping and dry friction of joints, written into a robot's URDF."""

from torch import Tensor

from forcegp.robots.robot import Robot
from forcegp.robots.urdf_file import replace_dynamics


def with_joint_dynamics(robot: Robot, damping: Tensor | None, friction: Tensor | None) -> Robot:
    """The robot whose URDF has <dynamics damping friction> (nv,) of every joint; None leaves what is there.

    That of a joint that others mimic includes theirs, which become 0.
    """
    text = robot.urdf_text
    free = {body for group in robot.layout.groups for body in range(group.bodies.start, group.bodies.stop)}
    for body, (joint, drive) in enumerate(zip(robot.layout.bodies, robot.layout.drives, strict=True)):
        if body in free:
            continue
        own = float(joint.name == robot.joint_names[drive.joint])
        values = {"damping": damping, "friction": friction}
        given = {name: own * float(value[drive.joint]) for name, value in values.items() if value is not None}
        text = replace_dynamics(text, joint.name, given, source=robot.source) if given else text
    return robot.with_text(text)
