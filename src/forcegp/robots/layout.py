"""Which body carries which link, in what order the joints come, whether all of it is a physical tree; its constants.

Movable joints are numbered depth first, children in the order in which their joints stand in the file. (Pinocchio
visits children alphabetically; map by joint name when comparing.) Each movable joint i moves *body* i: its child link
and every link fixed to it. Body i's frame is the child link's frame turned so that its z axis is the joint axis, which
makes every joint a rotation about or a translation along z.

A joint of several degrees of freedom stands for as many of these rows, one after the other, which all move together
(:mod:`forcegp.robots.manifold`). The last of them carries the links; the bodies of the others are empty.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import (
    InvalidInput,
    KinematicLoop,
    MissingInertia,
    NonPhysicalInertia,
    RobotModelError,
    UnknownJoint,
    UnknownLink,
    UnsupportedJoint,
    require_known,
)
from forcegp.robots.arguments import Inertials, broadcast_batch, usable_device
from forcegp.robots.inertia import (
    axis_inertia_vanishes,
    inverse,
    physical_objection,
    pseudo_inertia,
    pseudo_inertia_factor,
    rotation_about,
    rotation_of_z_onto,
    skew,
    transform,
    turns_with_inertia,
)
from forcegp.robots.manifold import MOTIONS, Group
from forcegp.robots.urdf import MOVABLE, JointDescription, RobotDescription, free_joint

WORLD = -1
BASE = "base"
"""Name of the joint between the world and a base that moves."""
OUTSIDE = "(world)"
"""What carries such a base; no link of the robot."""
Base = Literal["fixed", "floating", "planar", "spherical"]
"""Whether the root link is bolted to the world, moves freely, in the plane z = 0, or turns about its origin."""


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
    groups: tuple[Group, ...] = ()  # joints of several degrees of freedom

    @property
    def empty(self) -> frozenset[int]:
        """Bodies that carry nothing: all but the last of each group."""
        return frozenset(row for group in self.groups for row in range(group.rows.start, group.rows.stop - 1))

    @property
    def position_names(self) -> tuple[str, ...]:
        """Names of the entries of q: those of the joints, and of the positions of groups."""
        names: list[str] = []
        last = 0
        for group in self.groups:
            names += [joint.name for joint in self.joints[last : group.rows.start]]
            names += [f"{group.name}.{each}" for each in group.motion.positions]
            last = group.rows.stop
        return (*names, *(joint.name for joint in self.joints[last:]))

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
        require_known("link", link, robot, self.links, UnknownLink)
        if self.links[link].body == WORLD:
            raise InvalidInput(
                f"link {link!r} of {robot} is fixed in the world, so its inertia never enters the dynamics and "
                f"cannot be a parameter; name a moving link: {', '.join(self.moving)}"
            )


def lay_out(description: RobotDescription, locked: Mapping[str, float], base: Base = "fixed") -> Layout:
    """Order the joints, turn ``locked`` ones into fixed ones and merge fixed links into the bodies that carry them."""
    _check_locked(description, locked)
    root, children = _tree_of(description)
    joints: list[JointDescription] = []
    parents: list[int] = []
    origins: list[np.ndarray] = []
    groups: list[Group] = []
    links = {root: Placement(WORLD, np.eye(4))}
    stack = list(reversed(children[root]))
    if base not in get_args(Base):
        raise InvalidInput(f"base is {base!r}; give one of {', '.join(get_args(Base))}.")
    if base != "fixed":
        links = {OUTSIDE: Placement(WORLD, np.eye(4))}
        stack = [free_joint(BASE, base, OUTSIDE, root)]
    while stack:
        joint = stack.pop()
        above = links[joint.parent]
        offset = above.offset @ joint.origin
        if joint.type == "fixed" or joint.name in locked:
            links[joint.child] = Placement(above.body, offset @ _joint_motion(joint, locked.get(joint.name, 0.0)))
        else:
            turn = np.eye(4)
            rows = [joint]
            if joint.type in MOTIONS:
                first = sum(group.extra for group in groups) + len(joints)
                group = Group(joint.name, joint.type, len(joints), first)
                groups.append(group)
                rows = [
                    replace(
                        joint, name=f"{joint.name}.{each}", type="continuous" if each.startswith("r") else "prismatic"
                    )
                    for each in group.motion.velocities
                ]
            if joint.type not in ("floating", "spherical"):
                turn = transform(rotation_of_z_onto(joint.axis), np.zeros(3))
            links[joint.child] = Placement(len(joints) + len(rows) - 1, inverse(turn))
            joints += rows
            parents += [above.body] * len(rows)
            origins += [offset @ turn] * len(rows)
        stack.extend(reversed(children[joint.child]))
    if not joints:
        raise RobotModelError(
            f"{description.source}: robot {description.name!r} has no movable joint, so it has no dynamics; "
            f"use a URDF with at least one joint of type {', '.join(MOVABLE)} that is not locked."
        )
    links.pop(OUTSIDE, None)
    return Layout(tuple(joints), tuple(parents), tuple(origins), links, tuple(groups))


def _check_locked(description: RobotDescription, locked: Mapping[str, float]) -> None:
    by_name = {joint.name: joint for joint in description.joints}
    for name in locked:
        require_known("joint", name, description.source, by_name, UnknownJoint)
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


def check_inertias(description: RobotDescription, layout: Layout, tree: "Tree") -> None:
    """Every moving link must be physically possible and every body resist its joint, by itself or by its armature.

    A body resists a prismatic joint by its mass and any other joint by its inertia about the axis. Where all bodies do,
    the mass matrix is positive definite at every position: the moving joint nearest to the base moves its body by
    itself alone. Links fixed in the world need no inertia.
    """
    for name in layout.moving:
        inertial = description.links[name]
        objection = inertial and physical_objection(inertial.mass, inertial.center_of_mass, inertial.inertia)
        if objection:
            raise NonPhysicalInertia(
                f"{description.source}: no physical body has the inertia of link {name!r}: {objection}. Correct its "
                "<inertial> element (inertia is about the centre of mass, in kg m^2, in the axes of its <origin>), or "
                "take the nearest inertia that a body can have: `inertias='nearest'`."
            )
    bodies = tree.inertias[..., 0].numpy()
    whole = {group.rows.stop - 1: group for group in layout.groups}
    for body, joint in enumerate(layout.joints):
        if body in layout.empty:
            continue
        carried = [name for name, placement in layout.links.items() if placement.body == body and name != joint.child]
        others = f" and the links fixed to it ({', '.join(map(repr, carried))})" if carried else ""
        if bodies[body, 3, 3] == 0.0:
            raise MissingInertia(
                f"{description.source}: link {joint.child!r}{others} moves with joint {joint.name!r} but has no mass; "
                f"add an <inertial> element, make the joint fixed, or lock it with locked={{{joint.name!r}: 0.0}}."
            )
        if body in whole:
            if not turns_with_inertia(whole[body].kind, bodies[body]):
                raise NonPhysicalInertia(
                    f"{description.source}: link {joint.child!r}{others} turns with joint {whole[body].name!r} but has "
                    "no rotational inertia about some axis; correct its <inertial> element."
                )
        elif joint.type != "prismatic" and tree.armature[body] == 0.0 and axis_inertia_vanishes(bodies[body]):
            raise NonPhysicalInertia(
                f"{description.source}: link {joint.child!r}{others} turns with joint {joint.name!r} but has no "
                "rotational inertia about its axis, so any force would accelerate it infinitely; correct its "
                "<inertial> element, or give the rotor inertia of the joint with "
                f"armature={{{joint.name!r}: ...}} in kg m^2."
            )


@dataclass(frozen=True, eq=False)
class Level:
    """Joints of equal depth, whose poses are computed in one operation."""

    joints: Tensor | slice
    parents: Tensor | None  # positions in the previous level; None where that is the whole level, in order

    def to(self, device: torch.device) -> "Level":
        """The same level with its indices on another device."""
        joints = self.joints if isinstance(self.joints, slice) else self.joints.to(device)
        return Level(joints, None if self.parents is None else self.parents.to(device))


@dataclass(frozen=True, eq=False)
class Tree:
    """Constants of a tree with n movable joints, on one device. Index i is joint i and the body that it moves."""

    groups: tuple[Group, ...]
    positions: Tensor | None  # (n,) entry of q of each joint with one degree of freedom; None where that is i
    rest: Tensor  # (n, 4, 4, 1) and the next three: local transform = rest + sin q sine + cos q cosine + q slide
    sine: Tensor
    cosine: Tensor
    slide: Tensor
    levels: tuple[Level, ...]
    order: Tensor | None  # joint i's position when the levels are laid end to end; None where that is i
    revolute: Tensor  # (n, 1, 1): 1 for revolute and continuous joints, 0 for prismatic ones
    all_revolute: bool
    is_chain: bool
    descendants: Tensor  # (n, n): [i, j] = 1 where body j is moved by joint i, and is not empty
    ancestors: Tensor  # its transpose, with the empty bodies
    is_above: Tensor  # (n, n, 1): the same as truth values, transposed
    related: Tensor  # (n, n, 1): 1 where one of the two joints moves the other
    velocity_sum: Tensor  # (n, n): 2 ancestors - own joint, body velocity plus that of the parent body
    twist_basis: Tensor  # (12, 6): [w; v] -> [[w]x, v], row by row
    link_inertias: Tensor  # (links, 4, 4): pseudo-inertias of the moving links, in the frames of their bodies
    link_offsets: Tensor  # (links, 4, 4): poses of the moving links in those frames
    carried: Tensor  # (n, links): 1 where the body carries the link
    inertias: Tensor  # (n, 4, 4, 1): pseudo-inertias of the bodies, their links merged
    gravity: Tensor  # (3,)
    fall: Tensor  # (3, 4, 1): the acceleration T'' T^-1 of free fall
    armature: Tensor  # (n,)
    has_armature: bool

    def to(self, device: torch.device | str) -> "Tree":
        """The same constants on another device. Raises InvalidInput for one that is not there."""
        device = usable_device(device)
        moved = {key: value.to(device) for key, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **moved, levels=tuple(level.to(device) for level in self.levels))

    def equals(self, other: "Tree") -> bool:
        """Whether both move alike: equal joints, poses, inertias, gravity and armature, whatever their URDFs look like.

        Numbers may differ by rounding (1e-9, relative), as after writing a URDF and reading it again.
        """
        if self.rest.shape != other.rest.shape or self.groups != other.groups:
            return False
        constants = ("rest", "sine", "cosine", "slide", "descendants", "inertias", "gravity", "armature")
        return all(
            torch.allclose(getattr(self, name), getattr(other, name).to(self.rest.device), rtol=1e-9, atol=1e-12)
            for name in constants
        )


def compile_tree(description: RobotDescription, layout: Layout, gravity: np.ndarray, armature: np.ndarray) -> Tree:
    """Batched constants for :mod:`forcegp.robots.kinematics`, on the CPU."""
    n = len(layout.joints)
    revolute = np.array([joint.type != "prismatic" for joint in layout.joints])
    rest, sine, cosine, slide = np.zeros((4, n, 4, 4))
    own = np.eye(n)
    positions = np.arange(n)
    for group in layout.groups:
        own[group.rows, group.rows] = 1.0
        positions[group.rows] = group.places.start
        positions[group.rows.stop :] += group.extra
    moves = own.copy()  # [i, j] = 1 where body j is moved by joint i
    for i, (parent, origin) in enumerate(zip(layout.parents, layout.origins, strict=True)):
        x, y, z, translation = origin.T
        if own[i].sum() > 1:
            rest[i] = origin
        elif revolute[i]:  # origin @ Rz(q)
            rest[i].T[2:] = z, translation
            sine[i].T[:2] = y, -x
            cosine[i].T[:2] = x, y
        else:  # origin @ translation by q along z
            rest[i] = origin
            slide[i].T[3] = z
        if parent != WORLD:
            moves[:, i] += moves[:, parent]
    descendants = moves.copy()
    descendants[:, list(layout.empty)] = 0.0
    twist_basis = np.zeros((6, 3, 4))
    for k, axis in enumerate(np.eye(3)):
        twist_basis[k, :, :3] = skew(axis)
        twist_basis[3 + k, :, 3] = axis
    link_inertias = np.zeros((len(layout.moving), 4, 4))
    carried = np.zeros((n, len(layout.moving)))
    for k, name in enumerate(layout.moving):
        placement, inertial = layout.links[name], description.links[name]
        carried[placement.body, k] = 1.0
        if inertial is not None:
            local = pseudo_inertia(inertial.mass, inertial.center_of_mass, inertial.inertia)
            link_inertias[k] = placement.offset @ local @ placement.offset.T
    fall = np.zeros((3, 4))
    fall[:, 3] = gravity
    related = np.maximum(moves, moves.T)
    levels, order = _levels(layout.parents)

    def constant(array: np.ndarray) -> Tensor:
        return torch.tensor(array, dtype=torch.float64)

    return Tree(
        groups=layout.groups,
        positions=torch.as_tensor(positions) if layout.groups else None,
        rest=constant(rest[..., None]),
        sine=constant(sine[..., None]),
        cosine=constant(cosine[..., None]),
        slide=constant(slide[..., None]),
        levels=levels,
        order=order,
        revolute=constant(revolute[:, None, None]),
        all_revolute=bool(revolute.all()),
        is_chain=bool(related.all()),
        descendants=constant(descendants),
        ancestors=constant(moves.T),
        is_above=constant(moves[..., None]) > 0,
        related=constant(related[..., None]),
        velocity_sum=constant(2.0 * moves.T - own),
        twist_basis=constant(twist_basis.reshape(6, 12).T),
        link_inertias=constant(link_inertias),
        link_offsets=constant(np.stack([layout.links[name].offset for name in layout.moving])),
        carried=constant(carried),
        inertias=constant(np.tensordot(carried, link_inertias, 1)[..., None]),
        gravity=constant(gravity),
        fall=constant(fall[..., None]),
        armature=constant(armature),
        has_armature=bool(armature.any()),
    )


def merged_inertias(tree: Tree, layout: Layout, inertials: Inertials) -> Float[Tensor, "n 4 4 *batch"]:
    """Pseudo-inertias of the bodies where the named links have these log-Cholesky parameters (..., 10) instead."""
    names, moving = tuple(inertials), layout.moving
    batch = broadcast_batch({f"inertials[{name!r}]": inertials[name].shape[:-1] for name in names})
    parameters = torch.stack([inertials[name].expand(*batch, 10) for name in names])
    change = [moving.index(name) for name in names]
    factor = tree.link_offsets[change].reshape(len(names), *(1 for _ in batch), 4, 4) @ pseudo_inertia_factor(
        parameters
    )
    given = (factor @ factor.mT).movedim((-2, -1), (1, 2))
    # sum over the links that stay rather than subtract those that change: no cancellation
    stay = [i for i, name in enumerate(moving) if name not in inertials]
    kept = tree.carried[:, stay] @ tree.link_inertias[stay].flatten(1)
    added = (tree.carried[:, change] @ given.flatten(1)).unflatten(1, given.shape[1:])
    return kept.reshape(-1, 4, 4, *(1 for _ in batch)) + added


def _levels(parents: tuple[int, ...]) -> tuple[tuple[Level, ...], Tensor | None]:
    depth: list[int] = []
    for parent in parents:
        depth.append(0 if parent == WORLD else depth[parent] + 1)
    members = [[i for i, d in enumerate(depth) if d == level] for level in range(max(depth) + 1)]
    levels = []
    for level, joints in enumerate(members):
        above = [members[level - 1].index(parents[i]) for i in joints] if level else None
        whole = above is None or above == list(range(len(members[level - 1])))
        contiguous = joints == list(range(joints[0], joints[-1] + 1))
        levels.append(
            Level(
                slice(joints[0], joints[-1] + 1) if contiguous else torch.tensor(joints),
                None if whole else torch.tensor(above),
            )
        )
    laid = [i for joints in members for i in joints]
    order = None if laid == sorted(laid) else torch.tensor(np.argsort(laid))
    return tuple(levels), order
