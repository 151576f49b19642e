"""Which body carries which link, in what order the joints come, and whether all of it is a tree.

Movable joints are numbered depth first, children in file order. Each moves a body: its child link, turned so that z is
the joint axis, and what is fixed to it. A mimic joint moves by ``multiplier q + offset``: M = G^T M_all G.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from forcegp.errors import InvalidInput, RobotModelError, UnknownName, require_known
from forcegp.robots.arguments import Problems
from forcegp.robots.inertia import inverse, rotation_about, rotation_of_z_onto, transform
from forcegp.robots.manifold import POSITIONS, VELOCITIES, Group
from forcegp.robots.urdf import MOVABLE, Joint, RobotDescription, free_joint

BaseChoice = Literal["fixed", "floating"]
"""How the root link is held: in the world, or not at all."""

Loops = Sequence[tuple[str, str, str]]
"""Names of equalities that hold two links together, and these."""
WORLDS = ("world", "map", "odom", "ground", "universe")
WORD = r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+"  # words of a name: FL foot, upper Leg, front left wheel
LIMB = r".*(foot|feet|toe|leg|wheel|ankle|knee|thigh|calf)s?|[lr]?hips?|shin|sole"
"""To walk or drive with; `base_footprint` is none."""
ROTOR = r".*(rotor|propeller)s?"
BODY = r"pelvis|flying|drone|uav|quadrotor|.*copter"
ENOUGH = {LIMB: 2, ROTOR: 3, BODY: 1}
"""So many tell. Rotors count on the links that stand still: motors of arms have some in other places."""
WORLD = -1
BASE = "base"  # name of the joint between the world and a base that moves
OUTSIDE = "(world)"  # what carries such a base; no link of the robot
MOST_BODIES = 1000  # matrices of all pairs of bodies are kept for a robot


def check_base(description: RobotDescription, standing: Sequence[str], problems: Problems) -> None:
    """Report a robot that nobody said is bolted to the world, where names speak of legs, wheels, rotors or flight.

    ``standing`` are the links that do not move, the root first (measured: benchmarks/robot_files.py).
    """
    if not standing:
        return  # nothing stands still
    root, still = standing[0], set(standing)
    mass = sum(inertial.mass for name in standing if (inertial := description.links[name]))
    asked = "base" in problems.given
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
            problems.errors.append(RobotModelError(doubt, question, {"base": "floating"}))
            return


class Drive(NamedTuple):
    """How the joint of a body moves: by the coordinate number ``joint``, as ``multiplier q + offset``."""

    joint: int
    multiplier: float
    offset: float


def followed(
    description: RobotDescription, locked: Mapping[str, float], problems: Problems
) -> tuple[dict[str, float], dict[str, tuple[str, float, float]]]:
    """Positions of joints that stand still, and of mimic joints the one that they follow in the end."""
    by_name = {joint.name: joint for joint in description.joints}
    held: dict[str, float] = dict(locked)
    drives: dict[str, tuple[str, float, float]] = {}
    for joint in description.joints:
        multiplier, offset, at, passed = 1.0, 0.0, joint, {joint.name}
        while at.mimics is not None and at.name not in locked:
            above = by_name.get(at.mimics.joint)
            if above is None or above.name in passed or above.type == "floating":
                last = (at if above is None else joint).mimics
                seen = f"{description.source}: joint {joint.name!r} mimics {last.joint if last else None!r}"
                why = "which the file lacks"
                if above:
                    why = "and so at last itself, or a joint of several degrees of freedom"
                advice = f", {why}; correct its <mimic>, or lock the joint."
                problems.errors.append(RobotModelError(seen, advice, {"locked": {joint.name: 0.0}}))
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


class Placement(NamedTuple):
    """Pose ``offset`` (4, 4) of a link in the frame of the ``body`` that carries it (``WORLD``: fixed in the world)."""

    body: int
    offset: np.ndarray


@dataclass(frozen=True)
class Layout:
    """The tree as plain Python: movable joints in order, the parent body of each, and the placement of every link."""

    bodies: tuple[Joint, ...]  # the joint that moves each body
    drives: tuple[Drive, ...]  # the row of G and the entry of g of each body
    joints: tuple[Joint, ...]  # those with a coordinate of their own
    parents: tuple[int, ...]
    origins: tuple[np.ndarray, ...]  # body frame at q = 0 in the parent body's frame
    links: dict[str, Placement]
    groups: tuple[Group, ...] = ()  # joints of several degrees of freedom
    base: BaseChoice = "fixed"  # how the root is held: as asked for, or by a joint of the file

    @property
    def empty(self) -> frozenset[int]:
        """Bodies that carry nothing: all but the last of each group."""
        return frozenset(body for group in self.groups for body in range(group.bodies.start, group.bodies.stop - 1))

    @property
    def position_names(self) -> tuple[str, ...]:
        """Names of the entries of q: those of the joints, and of the positions of groups."""
        names: list[str] = []
        last = 0
        for group in self.groups:
            names += [joint.name for joint in self.joints[last : group.rows.start]]
            names += [f"{group.name}.{each}" for each in POSITIONS]
            last = group.rows.stop
        return (*names, *(joint.name for joint in self.joints[last:]))

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the links that some joint moves."""
        return tuple(name for name, placement in self.links.items() if placement.body != WORLD)

    @property
    def standing(self) -> tuple[str, ...]:
        """Names of the links fixed in the world, the root first."""
        return tuple(name for name, placement in self.links.items() if placement.body == WORLD)

    @property
    def child_frames(self) -> np.ndarray:
        """Pose (bodies, 4, 4) of each body's child link in its frame."""
        return np.stack([self.links[joint.child].offset for joint in self.bodies])


def lay_out(
    description: RobotDescription, locked: Mapping[str, float], base: BaseChoice | None, problems: Problems
) -> Layout:
    """Order the joints and merge links that are fixed or locked; raises what makes them no tree, collects the rest."""
    by_name = {joint.name: joint for joint in description.joints}
    for name, position in locked.items():
        require_known("joint", name, description.source, by_name, UnknownName)
        if by_name[name].type == "fixed":
            raise InvalidInput(f"{description.source}: joint {name!r} is fixed already; remove it from `locked`.")
        if by_name[name].type == "floating" and position != 0.0:
            raise InvalidInput(f"{description.source}: joint {name!r} is floating, so it can be locked at 0 alone.")
    held, drives = followed(description, locked, problems)
    root, children = _tree_of(description)
    bodies: list[Joint] = []
    parents: list[int] = []
    origins: list[np.ndarray] = []
    groups: list[Group] = []
    links, stack, still = {root: Placement(WORLD, np.eye(4))}, list(reversed(children[root])), [root]
    for link in still:
        still += [joint.child for joint in children[link] if joint.type == "fixed" or joint.name in held]
    massive = any(inertial.mass for link in still if (inertial := description.links[link]))
    hung = root.lower() in WORLDS or not massive  # else such a joint carries something else than the robot itself
    below = [joint for link in still if hung for joint in children[link] if joint.name not in held]
    own = {joint.name for joint in below if joint.type == "floating"}  # the file's own hold of its base
    if base == "floating" and not own:
        links, stack = {OUTSIDE: Placement(WORLD, np.eye(4))}, [free_joint(BASE, OUTSIDE, root)]
    while stack:
        joint = stack.pop()
        above = links[joint.parent]
        offset, free = above.offset @ joint.origin, joint.type == "floating"
        bolted = joint.name in own and base == "fixed"
        if bolted or joint.type == "fixed" or joint.name in held:
            still = np.eye(4) if free else joint_motion(joint, held.get(joint.name, 0.0))
            links[joint.child] = Placement(above.body, offset @ still)
        else:
            rows, turn = [joint], transform(rotation_of_z_onto(joint.axis), np.zeros(3))
            if free:
                row = sum(body.name not in drives for body in bodies)
                groups.append(Group(joint.name, row, row + len(groups), len(bodies)))
                kinds = {each: "continuous" if each.startswith("r") else "prismatic" for each in VELOCITIES}
                rows = [replace(joint, name=f"{joint.name}.{each}", type=kind) for each, kind in kinds.items()]
                turn = np.eye(4)
            links[joint.child] = Placement(len(bodies) + len(rows) - 1, inverse(turn))
            bodies += rows
            parents += [above.body] * len(rows)
            origins += [offset @ turn] * len(rows)
        stack.extend(reversed(children[joint.child]))
    if not bodies:
        seen = f"{description.source}: robot {description.name!r} has no movable joint, so it has no dynamics"
        needed = f"at least one joint of type {', '.join(MOVABLE)} that is not locked"
        raise RobotModelError(f"{seen}; use a URDF with {needed}, or `base='floating'` for a body that moves freely.")
    if len(bodies) > MOST_BODIES:
        seen = f"{description.source}: {len(bodies)} joints move"
        raise RobotModelError(f"{seen}; forcegp takes up to {MOST_BODIES}, lock the others.")
    joints = {body.name: body for body in bodies if body.name not in drives}
    for body in (body for body in bodies if body.name in drives):  # rotors and friction of those that follow count, too
        name, multiplier, _ = drives[body.name]
        factors = {"armature": multiplier**2, "damping": multiplier**2, "friction": abs(multiplier)}
        sums = {key: getattr(joints[name], key) + by * getattr(body, key) for key, by in factors.items()}
        joints[name] = replace(joints[name], **sums)
    places = {name: place for place, name in enumerate(joints)}
    moved = [drives.get(joint.name, (joint.name, 1.0, 0.0)) for joint in bodies]
    drive = tuple(Drive(places[name], multiplier, offset) for name, multiplier, offset in moved)
    links.pop(OUTSIDE, None)
    hold: BaseChoice = base or ("floating" if own else "fixed")
    return Layout(
        tuple(bodies), drive, tuple(joints.values()), tuple(parents), tuple(origins), links, tuple(groups), hold
    )


def check_tree(layout: Layout, loops: Loops, problems: Problems) -> None:
    """Report links that an equality of the file holds together (its name, the links) although joints move them."""

    def moving(link: str) -> list[int]:
        above = [layout.links[link].body]
        while above[-1] != WORLD:
            above.append(layout.parents[above[-1]])
        return above[:-1]

    for name, *links in loops:
        if between := sorted(set(moving(links[0])) ^ set(moving(links[1]))):
            joints = ", ".join(layout.bodies[body].name for body in between)
            lock = f"Lock the joints between these links ({joints}) by `locked`"
            advice = f"{lock}, or take the equality out of the file where nothing holds them together."
            seen = f"{problems.source}: {name} closes a loop, from link {links[0]!r} to {links[1]!r}"
            why = "; a robot is a tree here, which would move in another way. "
            problems.errors.append(RobotModelError(seen, why + advice))


def _tree_of(description: RobotDescription) -> tuple[str, dict[str, list[Joint]]]:
    """Root link and the joints below each link; :class:`RobotModelError` where the joints form no single tree."""
    source = description.source
    above: dict[str, Joint] = {}
    children: dict[str, list[Joint]] = {link: [] for link in description.links}
    for joint in description.joints:
        if joint.child in above:
            both = f"joints {above[joint.child].name!r} and {joint.name!r}"
            seen = f"{source}: link {joint.child!r} has two parents, through {both}"
            raise RobotModelError(f"{seen}; a link can be the child of one joint only, remove one of them.")
        above[joint.child] = joint
        children[joint.parent].append(joint)
    roots = [link for link in description.links if link not in above]
    if len(roots) > 1:
        seen = f"{source}: the links form {len(roots)} separate parts, with base links {', '.join(map(repr, roots))}"
        raise RobotModelError(f"{seen}; connect them by (fixed) joints so that one base link remains.")
    below = list(roots)
    for link in below:
        below += [joint.child for joint in children[link]]
    reached = set(below)
    if (stray := next((link for link in description.links if link not in reached), None)) is not None:
        loop, link = [], stray
        while link not in loop:
            loop.append(link)
            link = above[link].parent
        loop = [*loop[loop.index(link) :], link]
        seen = f"{source}: the links {' <- '.join(map(repr, loop))} form a loop, and a robot is a tree here"
        raise RobotModelError(f"{seen}; remove one of its joints, and lock those that it leaves without a hold.")
    return roots[0], children


def joint_motion(joint: Joint, position: float) -> np.ndarray:
    """How a joint that stands still is displaced, (4, 4)."""
    if not position:
        return np.eye(4)
    if joint.type == "prismatic":
        return transform(np.eye(3), position * np.array(joint.axis))
    return transform(rotation_about(joint.axis, position), np.zeros(3))
