"""Joints that mimic another one: reduced coordinates.

A mimic joint moves its body by ``multiplier q + offset`` with q the position of another joint, or of the one that this
one mimics in turn. It has no coordinate: with G from the coordinates to the joints of all bodies,

    M = G^T M_all G,    bias = G^T bias_all,    J = J_all G,

exact, and with the inertia that the other joint feels of it. Nothing is elastic, and nothing slips.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from forcegp.errors import UnsupportedJoint
from forcegp.robots.problems import Problems
from forcegp.robots.urdf import FREE, JointDescription, RobotDescription


class Drive(NamedTuple):
    """How the joint of a body moves: by the coordinate number ``joint``, as ``multiplier q + offset``."""

    joint: int
    multiplier: float
    offset: float


def followed(
    description: RobotDescription, locked: Mapping[str, float], problems: Problems
) -> tuple[dict[str, float], dict[str, tuple[str, float, float]]]:
    """Joints that stand still, with their positions, and of mimic joints the one that they follow in the end.

    A joint that follows a locked or fixed one stands still, as does one with a multiplier of 0.
    """
    by_name = {joint.name: joint for joint in description.joints}
    held: dict[str, float] = dict(locked)
    drives: dict[str, tuple[str, float, float]] = {}
    for joint in description.joints:
        multiplier, offset, at, passed = 1.0, 0.0, joint, {joint.name}
        while at.mimics is not None and at.name not in locked:
            above = by_name.get(at.mimics.joint)
            if above is None or above.name in passed or above.type in FREE:
                problems.errors.append(_objection(description.source, joint, at, above is not None))
                multiplier, offset = 0.0, 0.0
                break
            offset += multiplier * at.mimics.offset
            multiplier *= at.mimics.multiplier
            passed.add(above.name)
            at = above
        if joint.mimics is None or joint.name in locked:
            continue
        if multiplier == 0.0 or at.type == "fixed" or at.name in locked:
            held[joint.name] = multiplier * locked.get(at.name, 0.0) + offset
        else:
            drives[joint.name] = (at.name, multiplier, offset)
    return held, drives


def _objection(source: str, joint: JointDescription, at: JointDescription, found: bool) -> UnsupportedJoint:
    """Why a joint cannot be followed to one with a coordinate: at the last one passed."""
    last = (joint if found else at).mimics
    seen = f"{source}: joint {joint.name!r} mimics {last.joint if last else None!r}"
    why = ", and so at last itself, or a joint of several degrees of freedom" if found else ", which the file lacks"
    return UnsupportedJoint(seen, f"{why}; correct its <mimic>, or lock the joint.", {"locked": {joint.name: 0.0}})


def with_followers(
    joints: Mapping[str, JointDescription],
    bodies: Sequence[JointDescription],
    drives: Mapping[str, tuple[str, float, float]],
) -> tuple[JointDescription, ...]:
    """The joints with damping and dry friction of those that follow them: factors of multiplier^2 and |multiplier|."""
    whole = dict(joints)
    for body in bodies:
        if body.name in drives:
            name, multiplier, _ = drives[body.name]
            damping = whole[name].damping + multiplier**2 * body.damping
            friction = whole[name].friction + abs(multiplier) * body.friction
            whole[name] = replace(whole[name], damping=damping, friction=friction)
    return tuple(whole.values())
