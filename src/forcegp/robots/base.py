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
ENDS = ("foot", "feet", "toe", "leg", "wheel", "ankle", "knee", "thigh", "calf", "propeller", "rotor")
"""How words end that name limbs to walk, drive or fly with; `base_footprint` is none, and rotors are checked apart."""
WORDS = ("hip", "lhip", "rhip", "shin", "sole")
FLIES = ("flying", "drone", "uav", "quadrotor", "copter", "quadcopter", "hexacopter", "multicopter")
LIMBS = 2
ROTORS = 3
"""On the links that stand still; motors of arms have some in other places."""


def check_choice(base: str | None) -> None:
    """Raise InvalidInput for another base than `BaseChoice` has."""
    if base is not None and base not in get_args(BaseChoice):
        raise InvalidInput(f"base is {base!r}; give 'fixed'. Floating and planar bases are not supported yet.")


def check_free(joint: JointDescription, at_root: bool, problems: Problems) -> None:
    """Report a joint of several degrees of freedom, unless it holds a root that is taken as fixed."""
    if not at_root:
        problems.errors.append(
            UnsupportedJoint(
                f"{problems.source}: joint {joint.name!r} is of type {joint.type!r}",
                ", which is supported at the root alone; make it a chain of prismatic and revolute joints with massive "
                "links between them, or lock it.",
                {"locked": {joint.name: 0.0}},
            )
        )
    elif problems.given.get("base") is None:
        problems.errors.append(_question(problems.source, f"joint {joint.name!r} is of type {joint.type!r}"))


def check_base(description: RobotDescription, standing: Sequence[str], base: str | None, problems: Problems) -> None:
    """Report a robot that nobody said is bolted to the world, unless that was done.

    ``standing`` are the links that do not move, the root first.
    """
    if any(isinstance(error, UnstatedBase) for error in problems.errors):
        return
    root = standing[0]
    masses = [inertial.mass for name in standing if (inertial := description.links[name])]
    if base is not None or not sum(masses) > 0.0:
        return
    holding = [joint for joint in description.joints if joint.parent == root]
    if root.lower() in WORLDS and description.links[root] is None and all(j.type == "fixed" for j in holding):
        return
    moving = [joint for joint in description.joints if joint.type != "fixed"]
    rotors = [joint.name for joint in moving if joint.parent in standing and _has(joint, ("propeller", "rotor"))]
    limbs = [name for name in description.links if _speaks(name, ENDS[:-1], WORDS)]
    bodies = [name for name in (description.name, *description.links) if _speaks(name, (), (*FLIES, "pelvis"))]
    for seen, enough in ((limbs, LIMBS), (rotors, ROTORS), (bodies, 1)):
        if len(seen) >= enough:
            mass = f"its base {root!r} has {sum(masses):.3g} kg"
            listed = ", ".join(map(repr, seen[:4]))
            problems.errors.append(_question(problems.source, f"{mass}, and there is {listed}"))
            return


def _question(source: str, seen: str) -> UnstatedBase:
    return UnstatedBase(
        f"{source}: this looks like a robot that is not bolted to the world: {seen}",
        ". base='fixed' takes it as bolted; floating bases are not supported yet.",
        {"base": "fixed"},
    )


def _has(joint: JointDescription, ends: tuple[str, ...]) -> bool:
    return _speaks(joint.name, ends, ()) or _speaks(joint.child, ends, ())


def _speaks(name: str, ends: tuple[str, ...], words: tuple[str, ...]) -> bool:
    """Whether a word of a name is one of these, or ends so: `FL_foot`, `upperLeg`, `front_left_wheel_2`."""
    found = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)
    return any((word := each.lower()) in words or word.removesuffix("s").endswith(ends) for each in found)
