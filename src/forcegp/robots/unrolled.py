"""One given robot as constants, and its rigid-body algorithms at given states, unrolled into scalars.

Every entry is a scalar of its own: a float, or an expression from which code is written (:mod:`forcegp.codegen.graph`).
What the robot's structure makes zero or one vanishes while the computation is written down. Arrays of NumPy hold the
scalars as objects, so that their operators write down products and sums entry by entry.

Body frames have their joint along z (:mod:`forcegp.robots.layout`), so that in body axes a joint is a rotation by q
about z. Quantities of body i are written in its own axes about its own origin. With w, w' and a the angular velocity,
angular acceleration and acceleration of the origin, and P the pseudo-inertia,

    A = [[w']x + [w]x [w]x, a]  (3 x 4),  F = A P,  force f = F[:, 3],  moment n = (F21 - F12, F02 - F20, F10 - F01)

which is the recursive Newton-Euler algorithm; the mass matrix is the composite-rigid-body algorithm, whose column j is
the wrench of the composite body under A of one unit of joint j (Featherstone, "Rigid Body Dynamics Algorithms", 2008,
ch. 5 and 6), carried to the joints above.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import torch

from forcegp.robots.layout import WORLD
from forcegp.robots.mimic import Drive
from forcegp.robots.structure import RobotStructure

Scalars: TypeAlias = np.ndarray[Any, np.dtype[np.object_]]
"""Floats and expressions; the operators of NumPy are theirs, entry by entry."""

# What is smaller in a rotation matrix or an inertia is rounding, as of the turn onto the joint axis: sin(pi) = 1e-16.
ROUNDING = 1e-15


@dataclass(frozen=True)
class UnrolledJoint:
    """Constants of a body and the joint that moves it: where it is at q = 0, in the axes of its parent body."""

    parent: int
    revolute: bool
    rotation: Scalars
    origin: Scalars
    drive: Drive


class UnrolledRobot:
    """The constants of a robot as floats, from which `UnrolledKinematics` unrolls its algorithms.

    Parameters: ``robot``; ``rounding``, below which entries of rotation matrices, of origins in m and of the merged
    inertias (relative to the largest entry) count as zero. They are those of the robot on the CPU.
    """

    def __init__(self, robot: RobotStructure, *, rounding: float = ROUNDING) -> None:
        layout, tree = robot.layout, robot.tree
        robot.require_vectors("compiled programs")
        self.robot, self.rounding = robot, rounding
        self.joints: tuple[UnrolledJoint, ...] = tuple(
            UnrolledJoint(
                parent,
                joint.type != "prismatic",
                self._scalars(torch.as_tensor(origin[:3, :3])),
                self._scalars(torch.as_tensor(origin[:3, 3])),
                drive,
            )
            for parent, joint, origin, drive in zip(
                layout.parents, layout.bodies, layout.origins, layout.drives, strict=True
            )
        )
        self.coupled = layout.coupled
        merged = tree.inertias[..., 0]
        self.inertias = [self._scalars(body, float(body.abs().max())) for body in merged]
        self.gravity = self._scalars(tree.gravity, 0.0)
        self.armature = self._scalars(tree.armature, 0.0)

    @property
    def nv(self) -> int:
        """Number of coordinates."""
        return self.robot.nv

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Each joint with each of those above it, where the mass matrix has entries below its diagonal.

        All pairs where joints mimic others: what they couple fills in.
        """
        if self.coupled:
            return [(k, i) for k in range(self.nv) for i in range(k)]
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


class UnrolledKinematics:
    """The rigid-body algorithms at given states; one scalar per joint; ``v`` only if they are needed.

    A scalar is a float, which is a constant, or an :class:`~forcegp.codegen.graph.Expression`. All results are arrays
    of scalars, in the units of :class:`~forcegp.robots.Robot`. ``inertias`` is one symmetric 4x4 pseudo-inertia
    (kg m^2, kg m, kg) per body in body axes, in place of the robot's. An entry that is structurally zero is 0.0.
    """

    def __init__(self, unrolled: UnrolledRobot, q: Sequence[Any], v: Sequence[Any] | None = None) -> None:
        self.unrolled = unrolled
        self.v = None if v is None else self._of_bodies(v)
        if unrolled.coupled:
            q = [q[k] * multiplier + offset for k, multiplier, offset in (joint.drive for joint in unrolled.joints)]
        self.rotations: list[Scalars] = []  # body axes -> parent's axes
        self.origins: list[Scalars] = []  # body's origin in the parent's frame
        for joint, position in zip(unrolled.joints, q, strict=True):
            if joint.revolute:
                known = isinstance(position, float)
                c, s = (math.cos(position), math.sin(position)) if known else (position.cos(), position.sin())
                self.rotations.append(joint.rotation @ scalars([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
                self.origins.append(joint.origin)
            else:
                self.rotations.append(joint.rotation)
                self.origins.append(joint.origin + joint.rotation[:, 2] * position)

    def mass_matrix(self, inertias: Sequence[Scalars] | None = None) -> Scalars:
        """Mass matrix (nv, nv), armature on the diagonal; 0.0 between joints of different branches."""
        joints, n = self.unrolled.joints, len(self.unrolled.joints)
        composite = list(self.unrolled.inertias if inertias is None else inertias)
        for i in reversed(range(n)):
            if joints[i].parent != WORLD:
                composite[joints[i].parent] = composite[joints[i].parent] + self._inertia_in_parent(i, composite[i])
        M = scalars([[0.0] * n for _ in range(n)])
        for j in range(n):
            P = composite[j]
            hx, hy = P[0, 3], P[1, 3]
            if joints[j].revolute:
                force, moment = scalars([-hy, hx, 0.0]), scalars([-P[0, 2], -P[1, 2], P[0, 0] + P[1, 1]])
            else:
                force, moment = scalars([0.0, 0.0, P[3, 3]]), scalars([hy, -hx, 0.0])
            i = j
            while True:
                M[i, j] = M[j, i] = moment[2] if joints[i].revolute else force[2]
                if joints[i].parent == WORLD:
                    break
                force, moment = self._wrench_in_parent(i, force, moment)
                i = joints[i].parent
        M = self._of_joints(self._of_joints(M).T).T
        M[np.diag_indices(len(M))] = M.diagonal() + self.unrolled.armature
        return M

    def bias_forces(self, inertias: Sequence[Scalars] | None = None) -> Scalars:
        """Coriolis, centrifugal and gravity forces (nv,): the tau that gives zero acceleration."""
        return self._joint_forces(self.v, None, inertias)

    def inverse_dynamics(self, a: Scalars, inertias: Sequence[Scalars] | None = None) -> Scalars:
        """Joint forces (nv,) that give the accelerations ``a``: ``M a + bias``."""
        return self._joint_forces(self.v, self._of_bodies(a), inertias) + self.unrolled.armature * a

    def gravity_forces(self, inertias: Sequence[Scalars] | None = None) -> Scalars:
        """Joint forces (nv,) that hold the robot still."""
        return self._joint_forces([0.0] * len(self.unrolled.joints), None, inertias)

    def _of_bodies(self, values: Sequence[Any] | Scalars) -> Any:
        """Velocities or accelerations of the joints of all bodies."""
        if not self.unrolled.coupled:
            return values
        return scalars([values[joint.drive.joint] * joint.drive.multiplier for joint in self.unrolled.joints])

    def _of_joints(self, values: Scalars) -> Scalars:
        """Rows at the joints of all bodies, added up at those with a coordinate."""
        if not self.unrolled.coupled:
            return values
        out = np.full((self.unrolled.nv, *values.shape[1:]), 0.0, dtype=object)
        for row, joint in zip(values, self.unrolled.joints, strict=True):
            out[joint.drive.joint] = out[joint.drive.joint] + row * joint.drive.multiplier
        return out

    def _accelerations(self, v: Sequence[Any], a: Sequence[Any] | None) -> list[Scalars]:
        """Accelerations A (3, 4) of all bodies at joint accelerations ``a`` (0 if None), less that of free fall."""
        base = scalars([[0.0, 0.0, 0.0, -g] for g in self.unrolled.gravity])
        w: list[Scalars] = []
        dw: list[Scalars] = []
        A: list[Scalars] = []
        for i, joint in enumerate(self.unrolled.joints):
            to_body = self.rotations[i].T
            above = base if joint.parent == WORLD else A[joint.parent]
            acceleration = to_body @ (above[:, :3] @ self.origins[i] + above[:, 3])
            if joint.parent == WORLD:
                wi = dwi = scalars([0.0] * 3)
            else:
                wi, dwi = to_body @ w[joint.parent], to_body @ dw[joint.parent]
            own = 0.0 if a is None else a[i]
            x, y = wi[1] * v[i], -(wi[0] * v[i])  # w x (z v), whose z is zero
            if joint.revolute:
                dwi = dwi + scalars([x, y, own])
                wi = wi + scalars([0.0, 0.0, v[i]])
            else:  # the term of Coriolis counts twice
                acceleration = acceleration + scalars([2.0 * x, 2.0 * y, own])
            w.append(wi)
            dw.append(dwi)
            A.append(np.column_stack([_turning(wi, dwi), acceleration]))
        return A

    def _joint_forces(
        self, v: Sequence[Any] | None, a: Sequence[Any] | None, inertias: Sequence[Scalars] | None
    ) -> Scalars:
        assert v is not None, "forces that depend on velocities need some"
        joints, n = self.unrolled.joints, len(self.unrolled.joints)
        forces, moments = ([scalars([0.0] * 3) for _ in range(n)] for _ in range(2))
        out = [0.0] * n
        accelerations = self._accelerations(v, a)
        for i in reversed(range(n)):
            F = accelerations[i] @ (self.unrolled.inertias if inertias is None else inertias)[i]
            force = forces[i] + F[:, 3]
            moment = moments[i] + scalars([F[x, y] - F[y, x] for x, y in ((2, 1), (0, 2), (1, 0))])
            out[i] = moment[2] if joints[i].revolute else force[2]
            parent = joints[i].parent
            if parent != WORLD:
                force, moment = self._wrench_in_parent(i, force, moment)
                forces[parent], moments[parent] = forces[parent] + force, moments[parent] + moment
        return self._of_joints(scalars(out))

    def _wrench_in_parent(self, i: int, force: Scalars, moment: Scalars) -> tuple[Scalars, Scalars]:
        """Force and moment of body i about its origin, in the axes and about the origin of its parent body."""
        force = self.rotations[i] @ force
        return force, self.rotations[i] @ moment + np.cross(self.origins[i], force)

    def _inertia_in_parent(self, i: int, P: Scalars) -> Scalars:
        """Pseudo-inertia of body i in its parent's frame: ``T P T^T``, block by block."""
        R, p, mass = self.rotations[i], self.origins[i], P[3, 3]
        first = R @ P[:3, 3]
        arm = first + p * (0.5 * mass)
        second = R @ P[:3, :3] @ R.T + (np.outer(arm, p) + np.outer(p, arm))
        column = (first + p * mass)[:, None]
        return symmetric(np.block([[second, column], [column.T, mass]]))


def symmetric(lower: Scalars) -> Scalars:
    """The full matrix of a lower triangle; what is above it is not read."""
    rows, columns = np.indices(lower.shape)
    return lower[np.maximum(rows, columns), np.minimum(rows, columns)]


def factorize(matrix: Scalars) -> tuple[Scalars, Scalars]:
    """``matrix = L^T D L`` with L unit lower-triangular, from the last row to the first, no square roots.

    Returns L (its diagonal 1.0) and the diagonal of D. The matrix is positive definite if and only if D is positive.
    Reads the lower triangle. Featherstone's LTDL, table 6.3: L has no entry where none fills in, and since joints are
    numbered with parents before children, nothing fills in for a mass matrix.
    """
    n, rest = len(matrix), matrix.copy()
    L = scalars(np.eye(n).tolist())
    for k in reversed(range(n)):
        for i in reversed(range(k)):
            if rest[k, i] != 0.0:
                L[k, i] = rest[k, i] * (1.0 / rest[k, k])
                rest[i, : i + 1] = rest[i, : i + 1] - rest[k, : i + 1] * L[k, i]
    return L, rest.diagonal()


def solve_factorized(L: Scalars, D_inverse: Scalars, b: Scalars) -> Scalars:
    """``(L^T D L)^-1 b``, L as :func:`factorize` returns it."""
    n, x = len(L), b.copy()
    for i in reversed(range(n - 1)):  # L^T x = b
        x[i] = x[i] - L[i + 1 :, i] @ x[i + 1 :]
    x = x * D_inverse
    for i in range(1, n):  # L x = ...
        x[i] = x[i] - L[i, :i] @ x[:i]
    return x


def _turning(w: Scalars, dw: Scalars) -> Scalars:
    """``[w']x + [w]x [w]x`` (3, 3)."""
    (x, y, z), (dx, dy, dz) = w, dw
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    rows = [[-(yy + zz), xy - dz, xz + dy], [xy + dz, -(xx + zz), yz - dx], [xz - dy, yz + dx, -(xx + yy)]]
    return scalars(rows)
