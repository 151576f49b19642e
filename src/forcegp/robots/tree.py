"""Constants of a tree of bodies as tensors, for :mod:`forcegp.robots.kinematics`, and bodies that resist nothing."""

from collections.abc import Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp.errors import MissingInertia, NonPhysicalInertia, RobotModelError
from forcegp.robots.arguments import usable_device
from forcegp.robots.inertia import (
    axis_inertia_vanishes,
    pseudo_inertia,
    skew,
    turns_with_inertia,
)
from forcegp.robots.layout import BASE, WORLD, Layout
from forcegp.robots.manifold import Group
from forcegp.robots.urdf import RobotDescription


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
    whole = {group.bodies.stop - 1: group for group in layout.groups}
    carried: list[list[str]] = [[] for _ in layout.bodies]
    for name, placement in layout.links.items():
        if placement.body != WORLD and name != layout.bodies[placement.body].child:
            carried[placement.body].append(name)
    for body, (joint, drive) in enumerate(zip(layout.bodies, layout.drives, strict=True)):
        if body in layout.empty:
            continue
        own = layout.joints[drive.joint].name == joint.name and float(tree.armature[drive.joint]) > 0.0
        if own or not broken.isdisjoint((joint.child, *carried[body])):
            continue
        others = f" and the links fixed to it ({', '.join(map(repr, carried[body]))})" if carried[body] else ""
        name = whole[body].name if body in whole else joint.name
        link, remedy = f"{description.source}: link {joint.child!r}{others}", {"locked": {name: 0.0}}
        if name == BASE and body in whole:
            remedy = {"base": "fixed"}
        if pseudo[body, 3, 3] == 0.0:
            seen = f"{link} moves with joint {name!r} but has no mass, and nor has what it carries"
            advice = "; add an <inertial> element, make the joint fixed, or lock it."
            found.append((drive.joint, MissingInertia(seen, advice, remedy)))
        elif body in whole and not turns_with_inertia(whole[body].kind, pseudo[body]):
            seen = f"{link} turns with joint {name!r} but has no rotational inertia about some axis"
            found.append((drive.joint, NonPhysicalInertia(seen, "; correct its <inertial> element.", remedy)))
        elif body not in whole and joint.type != "prismatic" and axis_inertia_vanishes(pseudo[body]):
            seen = f"{link} turns with joint {name!r} but has no rotational inertia about its axis"
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

    groups: tuple[Group, ...]
    positions: Tensor | None  # (nv,) entry of q of each joint of one degree of freedom; None where that is i
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
    ancestors: Tensor  # its transpose, empty bodies included
    is_above: Tensor  # (n, n, 1): the same the other way round, as truth values
    related: Tensor  # (n, n, 1): 1 where one of the two joints moves the other
    velocity_sum: Tensor  # (n, n): 2 ancestors - own joint, body velocity plus that of the parent body
    twist_basis: Tensor  # (12, 6): [w; v] -> [[w]x, v], row by row
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
        if self.coupling.shape != other.coupling.shape or self.groups != other.groups:
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
    own, positions = np.eye(n), np.arange(len(layout.joints))
    for group in layout.groups:
        own[group.bodies, group.bodies] = 1.0
        positions[group.rows] = group.place
        positions[group.rows.stop :] += group.extra
    moves = own.copy()  # [i, j] = 1 where body j is moved by joint i
    for i, (parent, origin) in enumerate(zip(layout.parents, layout.origins, strict=True)):
        x, y, z, translation = origin.T
        if own[i].sum() > 1.0:  # moved by `Group`
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
    inertias = np.zeros((n, 4, 4))
    for name in layout.moving:
        placement, inertial = layout.links[name], description.links[name]
        if inertial is not None:
            local = pseudo_inertia(inertial.mass, inertial.center_of_mass, inertial.inertia)
            inertias[placement.body] += placement.offset @ local @ placement.offset.T
    fall = np.zeros((3, 4))
    fall[:, 3] = gravity
    related = np.maximum(moves, moves.T)
    coupling = np.zeros((n, len(layout.joints)))
    for body, drive in enumerate(layout.drives):
        coupling[body, drive.joint] = drive.multiplier
    levels, order = _levels(layout.parents)

    def constant(array: Any) -> Tensor:
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
        inertias=constant(inertias[..., None]),
        gravity=constant(gravity),
        fall=constant(fall[..., None]),
        armature=constant(armature),
        has_armature=bool(armature.any()),
        coupling=constant(coupling),
        shift=constant([[drive.offset] for drive in layout.drives]),
        coupled=layout.coupled,
    )


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
