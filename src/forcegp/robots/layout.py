"""Which body carries which link, in what order the joints come, and whether all of it is a physical tree.

Movable joints are numbered depth first, children in the order in which their joints stand in the file. (Pinocchio
visits children alphabetically; map by joint name when comparing.) Each movable joint i moves *body* i: its child link
and every link fixed to it. Body i's frame is the child link's frame turned so that its z axis is the joint axis, which
makes every joint a rotation about or a translation along z.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from forcegp.errors import (
    InvalidInput,
    KinematicLoop,
    MissingInertia,
    NonPhysicalInertia,
    RobotModelError,
    UnknownJoint,
    UnknownLink,
    UnsupportedJoint,
    unknown_name_message,
)
from forcegp.robots.inertia import axis_inertia_vanishes, physical_objection, pseudo_inertia
from forcegp.robots.spatial import inverse, rotation_about, rotation_of_z_onto, transform
from forcegp.robots.urdf import MOVABLE, InertialDescription, JointDescription, RobotDescription

WORLD = -1


@dataclass(frozen=True)
class Placement:
    """Pose ``offset`` (4, 4) of a link in the frame of the ``body`` that carries it (``WORLD``: fixed in the world)."""

    body: int
    offset: np.ndarray


@dataclass(frozen=True)
class Layout:
    """The tree as plain Python: movable joints in order, the parent body of each, and the placement of every link."""

    joints: tuple[JointDescription, ...]
    parents: tuple[int, ...]
    origins: tuple[np.ndarray, ...]  # body frame at q = 0 in the parent body's frame
    links: dict[str, Placement]

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the links that some joint moves."""
        return tuple(name for name, placement in self.links.items() if placement.body != WORLD)

    @property
    def child_frames(self) -> np.ndarray:
        """Pose (n, 4, 4) of each joint's child link in the frame of the body that it leads."""
        return np.stack([self.links[joint.child].offset for joint in self.joints])

    def require_moving(self, link: str, robot: str) -> None:
        """Raise where ``link`` has no inertia that matters: it does not exist, or it is fixed in the world."""
        placement = self.links.get(link)
        if placement is None:
            raise UnknownLink(unknown_name_message("link", link, robot, self.links))
        if placement.body == WORLD:
            raise InvalidInput(
                f"link {link!r} of {robot} is fixed in the world, so its inertia never enters the dynamics and "
                f"cannot be a parameter; name a moving link: {', '.join(self.moving)}"
            )


def lay_out(description: RobotDescription, locked: Mapping[str, float]) -> Layout:
    """Order the joints, turn ``locked`` ones into fixed ones and merge fixed links into the bodies that carry them."""
    _check_locked(description, locked)
    root, children = _tree_of(description)
    joints: list[JointDescription] = []
    parents: list[int] = []
    origins: list[np.ndarray] = []
    links = {root: Placement(WORLD, np.eye(4))}
    stack = list(reversed(children[root]))
    while stack:
        joint = stack.pop()
        above = links[joint.parent]
        offset = above.offset @ joint.origin
        if joint.type == "fixed" or joint.name in locked:
            links[joint.child] = Placement(above.body, offset @ _joint_motion(joint, locked.get(joint.name, 0.0)))
        else:
            turn = transform(rotation_of_z_onto(joint.axis), np.zeros(3))
            links[joint.child] = Placement(len(joints), inverse(turn))
            joints.append(joint)
            parents.append(above.body)
            origins.append(offset @ turn)
        stack.extend(reversed(children[joint.child]))
    if not joints:
        raise RobotModelError(
            f"{description.source}: robot {description.name!r} has no movable joint, so it has no dynamics; "
            f"use a URDF with at least one joint of type {', '.join(MOVABLE)} that is not locked."
        )
    return Layout(tuple(joints), tuple(parents), tuple(origins), links)


def _check_locked(description: RobotDescription, locked: Mapping[str, float]) -> None:
    by_name = {joint.name: joint for joint in description.joints}
    for name in locked:
        if name not in by_name:
            raise UnknownJoint(unknown_name_message("joint", name, description.source, by_name))
        if by_name[name].type == "fixed":
            raise InvalidInput(f"{description.source}: joint {name!r} is fixed already; remove it from `locked`.")
    for joint in description.joints:
        if joint.mimics is not None and joint.name not in locked:
            raise UnsupportedJoint(
                f"{description.source}: joint {joint.name!r} mimics {joint.mimics!r}, which is not supported; lock it "
                f"with locked={{{joint.name!r}: position}}, or remove its <mimic> element to move it independently."
            )


def _tree_of(description: RobotDescription) -> tuple[str, dict[str, list[JointDescription]]]:
    """Root link and the joints below each link; :class:`KinematicLoop` where the joints form no single tree."""
    source = description.source
    above: dict[str, JointDescription] = {}
    children: dict[str, list[JointDescription]] = {link: [] for link in description.links}
    for joint in description.joints:
        if joint.child in above:
            raise KinematicLoop(
                f"{source}: link {joint.child!r} has two parents, through joints {above[joint.child].name!r} and "
                f"{joint.name!r}; a link can be the child of one joint only, remove one of them."
            )
        above[joint.child] = joint
        children[joint.parent].append(joint)
    roots = [link for link in description.links if link not in above]
    if len(roots) > 1:
        raise KinematicLoop(
            f"{source}: the links form {len(roots)} separate parts, with base links {', '.join(map(repr, roots))}; "
            "connect them by (fixed) joints so that one base link remains."
        )
    reached = set(roots)
    queue = list(roots)
    while queue:
        below = [joint.child for joint in children[queue.pop()]]
        reached.update(below)
        queue.extend(below)
    stray = next((link for link in description.links if link not in reached), None)
    if stray is not None:
        loop, link = [], stray
        while link not in loop:
            loop.append(link)
            link = above[link].parent
        loop = [*loop[loop.index(link) :], link]
        raise KinematicLoop(
            f"{source}: the links {' <- '.join(map(repr, loop))} form a loop; remove one of its joints "
            "(a closed mechanism needs a tree plus constraints)."
        )
    return roots[0], children


def _joint_motion(joint: JointDescription, position: float) -> np.ndarray:
    axis = np.array(joint.axis)
    if joint.type == "prismatic":
        return transform(np.eye(3), position * axis)
    return transform(rotation_about(axis, position), np.zeros(3)) if position else np.eye(4)


def check_inertias(description: RobotDescription, layout: Layout, armature: np.ndarray) -> None:
    """Every moving link must be physically possible and every body resist its joint, by itself or by ``armature`` (n,).

    A body resists a prismatic joint by its mass and any other joint by its inertia about the axis. Where all bodies do,
    the mass matrix is positive definite at every position: the moving joint nearest to the base moves its body by
    itself alone. Links fixed in the world need no inertia.
    """
    mass = np.zeros(len(layout.joints))
    bodies = np.zeros((len(layout.joints), 4, 4))
    for name, placement in layout.links.items():
        inertial: InertialDescription | None = description.links[name]
        if placement.body == WORLD or inertial is None:
            continue
        objection = physical_objection(inertial.mass, inertial.center_of_mass, inertial.inertia)
        if objection is not None:
            raise NonPhysicalInertia(
                f"{description.source}: no physical body has the inertia of link {name!r}: {objection}. Correct its "
                "<inertial> element (inertia is about the centre of mass, in kg m^2, in the axes of its <origin>), or "
                "take the nearest inertia that a body can have: `inertias='nearest'`."
            )
        mass[placement.body] += inertial.mass
        local = pseudo_inertia(inertial.mass, inertial.center_of_mass, inertial.inertia)
        bodies[placement.body] += placement.offset @ local @ placement.offset.T
    for body, joint in enumerate(layout.joints):
        carried = [name for name, placement in layout.links.items() if placement.body == body and name != joint.child]
        others = f" and the links fixed to it ({', '.join(map(repr, carried))})" if carried else ""
        if mass[body] == 0.0:
            raise MissingInertia(
                f"{description.source}: link {joint.child!r}{others} moves with joint {joint.name!r} but has no mass; "
                f"add an <inertial> element, make the joint fixed, or lock it with locked={{{joint.name!r}: 0.0}}."
            )
        if joint.type != "prismatic" and armature[body] == 0.0 and axis_inertia_vanishes(bodies[body]):
            raise NonPhysicalInertia(
                f"{description.source}: link {joint.child!r}{others} turns with joint {joint.name!r} but has no "
                "rotational inertia about its axis, so any force would accelerate it infinitely; correct its "
                "<inertial> element, or give the rotor inertia of the joint with "
                f"armature={{{joint.name!r}: ...}} in kg m^2."
            )
