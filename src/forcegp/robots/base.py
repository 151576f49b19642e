"""Whether a robot is bolted to the world: what a file says about it, and the question where it says nothing.

A URDF begins at a root link, and nothing in the format tells an arm on a table from a robot that walks, drives or
flies. To weld such a robot to the world would answer with wrong forces and no word. So the question is asked where

* a joint of several degrees of freedom holds the root (type floating or planar), or
* links that stand still have mass, no link called world holds them by a fixed joint, and names speak of two legs,
  wheels or rotors, of a pelvis, or of something that flies.

Measured on the files of `example-robot-data` and `pybullet_data` (benchmarks/robot_files.py).
"""

import re
from collections.abc import Sequence
from typing import Literal, get_args

from forcegp.errors import InvalidInput, UnstatedBase, UnsupportedJoint
from forcegp.robots.problems import Problems
from forcegp.robots.urdf import JointDescription, RobotDescription

BaseChoice = Literal["fixed"]
"""How the root link is held: "fixed" in the world."""

WORLDS = ("world", "map", "odom", "ground", "universe")
WORD = r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+"
"""Words of a name: FL foot, upper Leg, front left wheel."""
LIMB = r".*(foot|feet|toe|leg|wheel|ankle|knee|thigh|calf)s?|[lr]?hips?|shin|sole"
"""To walk or drive with; `base_footprint` is none."""
ROTOR = r".*(rotor|propeller)s?"
BODY = r"pelvis|flying|drone|uav|quadrotor|.*copter"
ENOUGH = {LIMB: 2, ROTOR: 3, BODY: 1}
"""So many tell. Rotors count on the links that stand still: motors of arms have some in other places."""


def check_choice(base: str | None) -> None:
    """Raise InvalidInput for another base than `BaseChoice` has."""
    if base is not None and base not in get_args(BaseChoice):
        raise InvalidInput(f"base is {base!r}; give 'fixed'. Floating and planar bases are not supported yet.")


def check_free(joint: JointDescription, at_root: bool, problems: Problems) -> None:
    """Report a joint of several degrees of freedom, unless it holds a root that is taken as fixed."""
    seen = f"joint {joint.name!r} is of type {joint.type!r}"
    if not at_root:
        advice = ", which is supported at the root alone; make it a chain of joints with massive links, or lock it."
        remedy = {"locked": {joint.name: 0.0}}
        problems.errors.append(UnsupportedJoint(f"{problems.source}: {seen}", advice, remedy))
    elif "base" not in problems.given:
        problems.errors.append(_question(problems.source, seen))


def check_base(description: RobotDescription, standing: Sequence[str], problems: Problems) -> None:
    """Report a robot that nobody said is bolted to the world, unless that was done.

    ``standing`` are the links that do not move, the root first.
    """
    root, still = standing[0], set(standing)
    mass = sum(inertial.mass for name in standing if (inertial := description.links[name]))
    asked = "base" in problems.given or any(isinstance(error, UnstatedBase) for error in problems.errors)
    if asked or not mass > 0.0:
        return
    holding = {joint.type for joint in description.joints if joint.parent == root}
    if root.lower() in WORLDS and description.links[root] is None and holding == {"fixed"}:
        return
    names = {LIMB: list(description.links), BODY: [description.name, *description.links]}
    turning = [joint for joint in description.joints if joint.type != "fixed" and joint.parent in still]
    names[ROTOR] = [f"{joint.name} {joint.child}" for joint in turning]
    for kind, enough in ENOUGH.items():
        found = [name for name in names[kind] if any(re.fullmatch(kind, x.lower()) for x in re.findall(WORD, name))]
        if len(found) >= enough:
            seen = f"its base {root!r} has {mass:.3g} kg, and there is {', '.join(map(repr, found[:4]))}"
            problems.errors.append(_question(problems.source, seen))
            return


def _question(source: str, seen: str) -> UnstatedBase:
    return UnstatedBase(
        f"{source}: this looks like a robot that is not bolted to the world: {seen}",
        ". base='fixed' takes it as bolted; floating bases are not supported yet.",
        {"base": "fixed"},
    )
