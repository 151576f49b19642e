"""Which body carries which link, in what order the joints come, whether all of it is a physical tree; its constants.

Movable joints are numbered depth first, children in the order in which their joints stand in the file. (Pinocchio
visits children alphabetically; map by joint name when comparing.) Each of them moves a *body*: its child link and all
links fixed to it. A body's frame is the child link's frame turned so that its z axis is the joint axis, which makes
every joint a rotation about or a translation along z.

A joint that mimics another one moves a body, too, but has no coordinate of its own (:mod:`forcegp.robots.mimic`). The
positions of the bodies' joints are ``G q + g`` with q those of the ``nv`` others; without mimic joints G is the
identity and body i is that of joint i.
"""

from collections.abc import Mapping, Set
from dataclasses import dataclass, replace
from typing import Any

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
    require_known,
)
from forcegp.robots.arguments import Inertials, broadcast_batch, usable_device
from forcegp.robots.base import check_free
from forcegp.robots.inertia import (
    axis_inertia_vanishes,
    inverse,
    pseudo_inertia,
    pseudo_inertia_factor,
    rotation_about,
    rotation_of_z_onto,
    skew,
    transform,
)
from forcegp.robots.mimic import Drive, followed, with_followers
from forcegp.robots.problems import Problems
from forcegp.robots.urdf import FREE, MOVABLE, JointDescription, RobotDescription

WORLD = -1
MOST_BODIES = 1000
"""Matrices of all pairs of bodies are kept for a robot."""


@dataclass(frozen=True)
class Placement:
    """Pose ``offset`` (4, 4) of a link in the frame of the ``body`` that carries it (``WORLD``: fixed in the world)."""

    body: int
    offset: np.ndarray


@dataclass(frozen=True)
class Layout:
    """The tree as plain Python: movable joints in order, the parent body of each, and the placement of every link."""

    bodies: tuple[JointDescription, ...]  # the joint that moves each body
    drives: tuple[Drive, ...]  # the row of G and the entry of g of each body
    joints: tuple[JointDescription, ...]  # those with a coordinate of their own
    parents: tuple[int, ...]
    origins: tuple[np.ndarray, ...]  # body frame at q = 0 in the parent body's frame
    links: dict[str, Placement]

    @property
    def coupled(self) -> bool:
        """Whether some joint mimics another one."""
        return len(self.joints) < len(self.bodies)

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

    def require_moving(self, link: str, robot: str) -> None:
        """Raise where ``link`` has no inertia that matters: it does not exist, or it is fixed in the world."""
        require_known("link", link, robot, self.links, UnknownLink)
        if self.links[link].body == WORLD:
            raise InvalidInput(
                f"link {link!r} of {robot} is fixed in the world, so its inertia never enters the dynamics and "
                f"cannot be a parameter; name a moving link: {', '.join(self.moving)}"
            )


def lay_out(description: RobotDescription, locked: Mapping[str, float], problems: Problems) -> Layout:
    """Order the joints, turn ``locked`` ones into fixed ones and merge fixed links into the bodies that carry them.

    Raises what makes the joints no tree; ``problems`` collects the others, as if their remedies were applied.
    """
    by_name = _check_locked(description, locked)
    held, drives = followed(description, locked, problems)
    root, children = _tree_of(description)
    bodies: list[JointDescription] = []
    parents: list[int] = []
    origins: list[np.ndarray] = []
    links = {root: Placement(WORLD, np.eye(4))}
    stack = list(reversed(children[root]))
    while stack:
        joint = stack.pop()
        above = links[joint.parent]
        offset = above.offset @ joint.origin
        free = joint.type in FREE
        if free and joint.name not in locked:
            check_free(joint, above.body == WORLD, problems)
        if free or joint.type == "fixed" or joint.name in held:
            still = np.eye(4) if free else _joint_motion(joint, held.get(joint.name, 0.0))
            links[joint.child] = Placement(above.body, offset @ still)
        else:
            turn = transform(rotation_of_z_onto(joint.axis), np.zeros(3))
            links[joint.child] = Placement(len(bodies), inverse(turn))
            bodies.append(joint)
            parents.append(above.body)
            origins.append(offset @ turn)
        stack.extend(reversed(children[joint.child]))
    if not bodies:
        raise RobotModelError(
            f"{description.source}: robot {description.name!r} has no movable joint, so it has no dynamics; "
            f"use a URDF with at least one joint of type {', '.join(MOVABLE)} that is not locked."
        )
    if len(bodies) > MOST_BODIES:
        raise RobotModelError(
            f"{description.source}: {len(bodies)} joints move; forcegp takes up to {MOST_BODIES}, lock the others."
        )
    names = [joint.name for joint in bodies if joint.name not in drives]
    places = {name: place for place, name in enumerate(names)}
    joints = with_followers({name: by_name[name] for name in names}, bodies, drives)
    moved = [drives.get(joint.name, (joint.name, 1.0, 0.0)) for joint in bodies]
    return Layout(
        tuple(bodies),
        tuple(Drive(places[name], multiplier, offset) for name, multiplier, offset in moved),
        joints,
        tuple(parents),
        tuple(origins),
        links,
    )


def _check_locked(description: RobotDescription, locked: Mapping[str, float]) -> dict[str, JointDescription]:
    by_name = {joint.name: joint for joint in description.joints}
    for name, position in locked.items():
        require_known("joint", name, description.source, by_name, UnknownJoint)
        if by_name[name].type == "fixed":
            raise InvalidInput(f"{description.source}: joint {name!r} is fixed already; remove it from `locked`.")
        if by_name[name].type in FREE and position != 0.0:
            raise InvalidInput(
                f"{description.source}: joint {name!r} is {by_name[name].type}, so it can be locked at 0 alone."
            )
    return by_name


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


def bodies_without_inertia(
    description: RobotDescription, layout: Layout, tree: "Tree", broken: Set[str]
) -> list[tuple[int, RobotModelError]]:
    """Bodies that resist their joint neither by themselves nor by armature, as coordinate and error.

    A body resists a prismatic joint by its mass and any other joint by its inertia about the axis. Where all bodies do,
    the mass matrix is positive definite at every position: the moving joint nearest to the base moves its body by
    itself alone. Where one does not, what it carries may. Links fixed in the world need no inertia; nothing is said of
    bodies with ``broken`` links.
    """
    pseudo, found = tree.inertias[..., 0].numpy(), []
    carried: list[list[str]] = [[] for _ in layout.bodies]
    for name, placement in layout.links.items():
        if placement.body != WORLD and name != layout.bodies[placement.body].child:
            carried[placement.body].append(name)
    for body, (joint, drive) in enumerate(zip(layout.bodies, layout.drives, strict=True)):
        own = layout.joints[drive.joint].name == joint.name and float(tree.armature[drive.joint]) > 0.0
        if own or not broken.isdisjoint((joint.child, *carried[body])):
            continue
        others = f" and the links fixed to it ({', '.join(map(repr, carried[body]))})" if carried[body] else ""
        link, remedy = f"{description.source}: link {joint.child!r}{others}", {"locked": {joint.name: 0.0}}
        if pseudo[body, 3, 3] == 0.0:
            seen = f"{link} moves with joint {joint.name!r} but has no mass, and nor has what it carries"
            advice = "; add an <inertial> element, make the joint fixed, or lock it."
            found.append((drive.joint, MissingInertia(seen, advice, remedy)))
        elif joint.type != "prismatic" and axis_inertia_vanishes(pseudo[body]):
            seen = f"{link} turns with joint {joint.name!r} but has no rotational inertia about its axis"
            advice = (
                ": any force would accelerate it infinitely. Correct its <inertial> element, give the joint the "
                "inertia of its rotor (`armature`, in kg m^2), or lock it."
            )
            found.append((drive.joint, NonPhysicalInertia(seen, advice, remedy)))
    return found


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
    """Constants of a tree with n bodies, on one device. Index i is body i and the joint that moves it."""

    rest: Tensor  # (n, 4, 4, 1) and the next three: local transform = rest + sin q sine + cos q cosine + q slide
    sine: Tensor
    cosine: Tensor
    slide: Tensor
    levels: tuple[Level, ...]
    order: Tensor | None  # joint i's position when the levels are laid end to end; None where that is i
    revolute: Tensor  # (n, 1, 1): 1 for revolute and continuous joints, 0 for prismatic ones
    all_revolute: bool
    is_chain: bool
    descendants: Tensor  # (n, n): [i, j] = 1 where body j is moved by joint i
    ancestors: Tensor  # its transpose
    is_above: Tensor  # (n, n, 1): descendants as truth values
    related: Tensor  # (n, n, 1): 1 where one of the two joints moves the other
    velocity_sum: Tensor  # (n, n): 2 ancestors - 1, body velocity plus that of the parent body
    twist_basis: Tensor  # (12, 6): [w; v] -> [[w]x, v], row by row
    link_inertias: Tensor  # (links, 4, 4): pseudo-inertias of the moving links, in the frames of their bodies
    link_offsets: Tensor  # (links, 4, 4): poses of the moving links in those frames
    carried: Tensor  # (n, links): 1 where the body carries the link
    inertias: Tensor  # (n, 4, 4, 1): pseudo-inertias of the bodies, their links merged
    gravity: Tensor  # (3,)
    fall: Tensor  # (3, 4, 1): the acceleration T'' T^-1 of free fall
    armature: Tensor  # (nv,)
    has_armature: bool
    coupling: Tensor  # (n, nv): G, the velocity of each body's joint per unit of those with a coordinate
    shift: Tensor  # (n, 1): g, their positions at q = 0
    coupled: bool  # whether some joint mimics another; else G is the identity and g is zero

    def to(self, device: torch.device | str) -> "Tree":
        """The same constants on another device. Raises InvalidInput for one that is not there."""
        device = usable_device(device)
        moved = {key: value.to(device) for key, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **moved, levels=tuple(level.to(device) for level in self.levels))

    def equals(self, other: "Tree") -> bool:
        """Whether both move alike: equal joints, poses, inertias, gravity and armature, whatever their URDFs look like.

        Numbers may differ by rounding (1e-9, relative), as after writing a URDF and reading it again.
        """
        if self.coupling.shape != other.coupling.shape:
            return False
        constants = ("rest", "sine", "cosine", "slide", "descendants", "inertias", "gravity", "armature", "coupling")
        return all(
            torch.allclose(getattr(self, name), getattr(other, name).to(self.rest.device), rtol=1e-9, atol=1e-12)
            for name in (*constants, "shift")
        )


def compile_tree(description: RobotDescription, layout: Layout, gravity: np.ndarray, armature: np.ndarray) -> Tree:
    """Batched constants for :mod:`forcegp.robots.kinematics`, on the CPU."""
    n = len(layout.bodies)
    revolute = np.array([joint.type != "prismatic" for joint in layout.bodies])
    rest, sine, cosine, slide = np.zeros((4, n, 4, 4))
    descendants = np.eye(n)
    for i, (parent, origin) in enumerate(zip(layout.parents, layout.origins, strict=True)):
        x, y, z, translation = origin.T
        if revolute[i]:  # origin @ Rz(q)
            rest[i].T[2:] = z, translation
            sine[i].T[:2] = y, -x
            cosine[i].T[:2] = x, y
        else:  # origin @ translation by q along z
            rest[i] = origin
            slide[i].T[3] = z
        if parent != WORLD:
            descendants[:, i] += descendants[:, parent]
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
    related = np.maximum(descendants, descendants.T)
    coupling = np.zeros((n, len(layout.joints)))
    for body, drive in enumerate(layout.drives):
        coupling[body, drive.joint] = drive.multiplier
    levels, order = _levels(layout.parents)

    def constant(array: Any) -> Tensor:
        return torch.tensor(array, dtype=torch.float64)

    return Tree(
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
        ancestors=constant(descendants.T),
        is_above=constant(descendants[..., None]) > 0,
        related=constant(related[..., None]),
        velocity_sum=constant(2.0 * descendants.T - np.eye(n)),
        twist_basis=constant(twist_basis.reshape(6, 12).T),
        link_inertias=constant(link_inertias),
        link_offsets=constant(np.stack([layout.links[name].offset for name in layout.moving])),
        carried=constant(carried),
        inertias=constant(np.tensordot(carried, link_inertias, 1)[..., None]),
        gravity=constant(gravity),
        fall=constant(fall[..., None]),
        armature=constant(armature),
        has_armature=bool(armature.any()),
        coupling=constant(coupling),
        shift=constant([[drive.offset] for drive in layout.drives]),
        coupled=layout.coupled,
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
