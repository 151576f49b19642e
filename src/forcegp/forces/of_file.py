"""The forces that a robot's file states."""

from forcegp.forces.actuation import Actuation
from forcegp.forces.force import Force
from forcegp.forces.friction import Coulomb, Viscous
from forcegp.forces.offset import Spring
from forcegp.forces.rigid_bodies import RigidBodies
from forcegp.forces.thrusters import Thrusters
from forcegp.robots import Robot
from forcegp.robots.mjcf_model import Translation


def forces_of_file(robot: Robot) -> tuple[Force, ...]:
    """What a robot's file states: actuation, rigid bodies, and joint damping and dry friction where it has them."""
    named = {joint.name: joint for joint in robot.joints if joint.name in robot.single_joint_names}
    damping = {name: joint.damping for name, joint in named.items() if joint.damping}
    friction = {name: joint.friction for name, joint in named.items() if joint.friction}
    laws = ((Viscous(damping),) if damping else ()) + ((Coulomb(friction),) if friction else ())
    return (Actuation(), RigidBodies(), *laws)


def forces_of_mjcf(robot: Robot, found: Translation) -> tuple[Force, ...]:
    """The same and springs; u are joint forces, or the inputs of all motors where some act elsewhere.

    Those of bodies that are not free come last.
    """
    actuation, moving = Actuation(), set(robot.joint_names)  # without those that are locked
    motors = [each for each in found.motors if moving & set(each.column)]
    pushing = [each for each in found.motors if each.link and robot.frame(each.link)[0] >= 0]
    if pushing or any(moving & set(each.column) - set(robot.single_joint_names) for each in motors):
        matrix = [[each.column.get(joint, 0.0) for each in motors] for joint in robot.joint_names]
        actuation = Actuation(matrix, tuple(each.name for each in motors))
    thrusters = (Thrusters.of_wrench(each.link, each.wrench, each.name) for each in pushing)
    sprung = {name: each for name, each in found.springs.items() if name in moving}
    stiffness, rest = ({name: each[k] for name, each in sprung.items()} for k in (0, 1))
    springs = (Spring(stiffness, rest),) if sprung else ()
    return (actuation, *thrusters, *forces_of_file(robot)[1:], *springs)
