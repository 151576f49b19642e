"""One given robot as constants, from which its rigid-body algorithms are unrolled into scalars.

Where :mod:`forcegp.robots.algorithms` computes with (n, 4, 4, batch) tensors for any tree, here every entry is a scalar
of its own (:mod:`forcegp.robots.scalar_algebra`): a tensor (batch,), a float, or an expression from which code is
written (:mod:`forcegp.robots.expressions`). Everything that the robot's structure makes zero or one vanishes while the
computation is written down. The algorithms are in :mod:`forcegp.robots.unrolled_kinematics`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from forcegp.robots.scalar_algebra import Matrix
from forcegp.robots.structure import RobotStructure

# What is smaller in a rotation matrix or an inertia is rounding, for example of the turn onto the joint axis: sin(pi) =
# 1e-16.
ROUNDING = 1e-15


@dataclass(frozen=True)
class UnrolledJoint:
    """Constants of a joint: body i at q = 0 in the axes of its parent body."""

    parent: int
    revolute: bool
    rotation: list[list[float]]
    origin: list[float]


class UnrolledRobot:
    """The constants of a robot as floats, from which `UnrolledKinematics` unrolls its algorithms.

    Parameters: ``robot``; ``rounding``, below which entries of rotation matrices, of origins in m and of the merged
    inertias (relative to the largest entry) count as zero. The constants are those of the robot on the CPU; states
    may be tensors on any device.
    """

    def __init__(self, robot: RobotStructure, *, rounding: float = ROUNDING) -> None:
        layout, tree = robot.layout, robot.tree
        self.robot, self.rounding = robot, rounding
        self.joints: tuple[UnrolledJoint, ...] = tuple(
            UnrolledJoint(
                parent,
                joint.type != "prismatic",
                self._floats(torch.as_tensor(origin[:3, :3])),
                self._floats(torch.as_tensor(origin[:3, 3])),
            )
            for parent, joint, origin in zip(layout.parents, layout.joints, layout.origins, strict=True)
        )
        merged = tree.inertias[..., 0]
        self.inertias: list[Matrix] = [self._floats(body, float(body.abs().max())) for body in merged]
        self.gravity: list[float] = self._floats(tree.gravity, 0.0)
        self.armature: list[float] = self._floats(tree.armature, 0.0)

    @property
    def nv(self) -> int:
        """Number of movable joints."""
        return len(self.joints)

    def frame(self, name: str) -> tuple[int, list[list[float]], list[float]]:
        """Body that carries a frame (``WORLD`` = -1), and the frame's rotation and origin in that body's frame."""
        body, offset = self.robot.frame(name)
        return body, self._floats(offset[:3, :3]), self._floats(offset[:3, 3])

    def _floats(self, values: torch.Tensor, scale: float = 1.0) -> list:
        """Nested lists, with 0.0 for what is rounding beside ``scale``."""
        values = values.detach().cpu()
        return torch.where(values.abs() <= self.rounding * scale, 0.0, values).tolist()
