"""Whether a robot is bolted to the world: what a file says about it, and the question where it says nothing.

A URDF begins at a root link, and nothing in the format tells an arm on a table from a robot that walks, drives or
flies. To weld such a robot to the world would answer with wrong forces and no word. So the question is asked where
links that stand still have mass, no link called world holds them by a fixed joint, and names speak of two legs, wheels
or rotors, of a pelvis, or of something that flies. A file whose root hangs on a joint of type floating or planar says
so itself.

Measured on the files of `example-robot-data` and `pybullet_data` (benchmarks/robot_files.py).
"""

import re
from collections.abc import Sequence
from typing import Literal, get_args

from forcegp.errors import InvalidInput, UnstatedBase
from forcegp.robots.problems import Problems
from forcegp.robots.urdf import RobotDescription

BaseChoice = Literal["fixed", "floating", "planar", "spherical"]
"""How the root link is held: "fixed" in the world, free, free in the plane z = 0, or free to turn about its origin."""

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
        raise InvalidInput(f"base is {base!r}; give one of {', '.join(get_args(BaseChoice))}.")


def check_base(description: RobotDescription, standing: Sequence[str], problems: Problems) -> None:
    """Report a robot that nobody said is bolted to the world, unless that was done.

    ``standing`` are the links that do not move, the root first.
    """
    if not standing:
        return  # nothing stands still
    root, still = standing[0], set(standing)
    mass = sum(inertial.mass for name in standing if (inertial := description.links[name]))
    asked = "base" in problems.given or any(isinstance(error, UnstatedBase) for error in problems.errors)
    if asked or mass == 0.0:  # one that is NaN or negative is a mistake, and no sign of a robot that is bolted
        return
    holding = {joint.type for joint in description.joints if joint.parent == root}
    if root.lower() in WORLDS and description.links[root] is None and "fixed" in holding:
        return
    names = {LIMB: list(description.links), BODY: [description.name, *description.links]}
    turning = [joint for joint in description.joints if joint.type != "fixed" and joint.parent in still]
    names[ROTOR] = [f"{joint.name} {joint.child}" for joint in turning]
    for kind, enough in ENOUGH.items():
        found = [name for name in names[kind] if any(re.fullmatch(kind, x.lower()) for x in re.findall(WORD, name))]
        if len(found) >= enough:
            seen = f"its base {root!r} has {mass:.3g} kg, and there is {', '.join(map(repr, found[:4]))}"
            doubt = f"{problems.source}: this looks like a robot that is not bolted to the world: {seen}"
            question = ". base='floating' lets it move freely; base='fixed' takes it as bolted."
            problems.errors.append(UnstatedBase(doubt, question, {"base": "floating"}))
            return
