"""Units of what belongs to joints, and names with units: some joints turn, some slide."""

from __future__ import annotations

from collections.abc import Sequence

from forcegp.robots import Robot

UNITS = {"q": ("rad", "m"), "v": ("rad/s", "m/s"), "a": ("rad/s^2", "m/s^2"), "u": ("Nm", "N")}
"""Of positions, velocities, accelerations and forces, for joints that turn and joints that slide."""


def joint_units(quantity: str, joints: Sequence[str], robot: Robot) -> tuple[str, ...]:
    """The unit that a key of `UNITS` has at each of the joints."""
    turning, sliding = UNITS[quantity]
    slides = {joint.name for joint in robot.joints if joint.type == "prismatic"}
    return tuple(sliding if name in slides else turning for name in joints)


def joint_labels(what: str, quantity: str, joints: Sequence[str], robot: Robot) -> tuple[str, ...]:
    """`what` of every joint with its unit, for example "velocity of joint_1 [rad/s]"."""
    units = joint_units(quantity, joints, robot)
    return tuple(f"{what} of {name} [{unit}]" for name, unit in zip(joints, units, strict=True))
