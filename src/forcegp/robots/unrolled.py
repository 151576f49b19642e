"""One given robot as constants, from which its rigid-body algorithms are unrolled into scalars.

Where :mod:`forcegp.robots.algorithms` computes with (n, 4, 4, batch) tensors for any tree, here every entry is a scalar
of its own: a float, or an expression from which code is written (:mod:`forcegp.codegen.graph`). Everything that the
robot's structure makes zero or one vanishes while the computation is written down. The algorithms are in
:mod:`forcegp.robots.unrolled_kinematics`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import torch

from forcegp.robots.layout import WORLD
from forcegp.robots.structure import RobotStructure

Scalars: TypeAlias = np.ndarray[Any, np.dtype[np.object_]]
"""Floats and expressions; the operators of NumPy are theirs, entry by entry."""

# What is smaller in a rotation matrix or an inertia is rounding, for example of the turn onto the joint axis: sin(pi) =
# 1e-16.
ROUNDING = 1e-15


@dataclass(frozen=True)
class UnrolledJoint:
    """Constants of a joint: body i at q = 0 in the axes of its parent body."""

    parent: int
    revolute: bool
    rotation: Scalars
    origin: Scalars


class UnrolledRobot:
    """The constants of a robot as floats, from which `UnrolledKinematics` unrolls its algorithms.

    Parameters: ``robot``; ``rounding``, below which entries of rotation matrices, of origins in m and of the merged
    inertias (relative to the largest entry) count as zero. They are those of the robot on the CPU.
    """

    def __init__(self, robot: RobotStructure, *, rounding: float = ROUNDING) -> None:
        layout, tree = robot.layout, robot.tree
        self.robot, self.rounding = robot, rounding
        self.joints: tuple[UnrolledJoint, ...] = tuple(
            UnrolledJoint(
                parent,
                joint.type != "prismatic",
                self._scalars(torch.as_tensor(origin[:3, :3])),
                self._scalars(torch.as_tensor(origin[:3, 3])),
            )
            for parent, joint, origin in zip(layout.parents, layout.joints, layout.origins, strict=True)
        )
        merged = tree.inertias[..., 0]
        self.inertias = [self._scalars(body, float(body.abs().max())) for body in merged]
        self.gravity = self._scalars(tree.gravity, 0.0)
        self.armature = self._scalars(tree.armature, 0.0)

    @property
    def nv(self) -> int:
        """Number of movable joints."""
        return len(self.joints)

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Each joint with each of those above it, where the mass matrix has entries below its diagonal."""
        above: list[list[int]] = []
        for joint in self.joints:
            above.append([] if joint.parent == WORLD else [*above[joint.parent], joint.parent])
        return [(k, i) for k, found in enumerate(above) for i in found]

    def _scalars(self, values: torch.Tensor, scale: float = 1.0) -> Scalars:
        """The numbers, with 0.0 for what is rounding beside ``scale``."""
        values = values.detach().cpu()
        return scalars(torch.where(values.abs() <= self.rounding * scale, 0.0, values).tolist())


def scalars(values: list) -> Scalars:
    """Nested lists of floats and expressions as an array."""
    return np.array(values, dtype=object)
