"""The dynamics of one robot as machine code: its rigid-body algorithms unrolled into scalars, and `CompiledRobot`.

Entries are floats or expressions, so what the structure makes zero vanishes. Quantities of a body are in its own axes,
about its own origin: A = [[w']x + [w]x [w]x, a], F = A P with the pseudo-inertia P (Featherstone 2008, ch. 5 and 6).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from forcegp.codegen.c_writer import Program, write_program
from forcegp.codegen.graph import Expression, Graph, node_of
from forcegp.codegen.library import NOT_POSITIVE, RowFunction, are_plain, default_folder, load_library, require_plain
from forcegp.codegen.tracing import trace
from forcegp.errors import InvalidInput, NumericalError
from forcegp.robots.arguments import broadcast_batch
from forcegp.robots.kinematics import NOT_POSITIVE_DEFINITE
from forcegp.robots.layout import WORLD, Drive
from forcegp.robots.manifold import NEUTRAL, pose
from forcegp.robots.structure import RigidBodyDynamics, RobotStructure

Scalars: TypeAlias = np.ndarray[Any, np.dtype[np.object_]]
"""Floats and expressions; the operators of NumPy are theirs, entry by entry."""
_Values: TypeAlias = Sequence[Any] | Scalars

# What is smaller in a rotation matrix, an origin in m or, beside its largest entry, an inertia, is rounding, as of the
# turn onto the joint axis: sin(pi) = 1e-16.
ROUNDING = 1e-15


@dataclass(frozen=True)
class UnrolledJoint:
    """A degree of freedom: velocity `axis` of the six of body `rows[-1]`."""

    parent: int
    axis: int
    rotation: Scalars
    origin: Scalars
    drive: Drive
    rows: range
    positions: slice

    @property
    def revolute(self) -> bool:
        """Whether it turns the body."""
        return self.axis >= 3


class UnrolledRobot:
    """The constants of a robot as floats, from which `UnrolledKinematics` unrolls its algorithms."""

    def __init__(self, robot: RobotStructure) -> None:
        layout, tree = robot.layout, robot.tree
        self.robot = robot
        places = range(robot.nv) if tree.positions is None else tree.positions.tolist()
        whole = {body: group for group in layout.groups for body in range(*group.bodies.indices(len(layout.bodies)))}
        joints = []
        for body, (parent, joint, origin, drive) in enumerate(
            zip(layout.parents, layout.bodies, layout.origins, layout.drives, strict=True)
        ):
            group = whole.get(body)
            if group is None:
                place = places[drive.joint]
                axis, rows = 2 if joint.type == "prismatic" else 5, range(body, body + 1)
                positions = slice(place, place + 1)
            else:
                axis, rows = body - group.body, range(group.bodies.start, group.bodies.stop)
                positions = group.places
            rotation, offset = (self._scalars(torch.as_tensor(part)) for part in (origin[:3, :3], origin[:3, 3]))
            joints.append(UnrolledJoint(parent, axis, rotation, offset, drive, rows, positions))
        self.joints: tuple[UnrolledJoint, ...] = tuple(joints)
        self.coupled = layout.coupled
        merged = tree.inertias[..., 0]
        self.inertias = [self._scalars(body, float(body.abs().max())) for body in merged]
        self.gravity = self._scalars(tree.gravity, 0.0)
        self.armature = self._scalars(tree.armature, 0.0)

    @property
    def constants(self) -> list[object]:
        """All that decides the code."""
        found: list[object] = [(joint.parent, joint.axis, *joint.drive) for joint in self.joints]
        found += [x.tolist() for joint in self.joints for x in (joint.rotation, joint.origin)]
        return [*found, self.gravity.tolist(), self.armature.tolist(), [body.tolist() for body in self.inertias]]

    @property
    def nv(self) -> int:
        """Number of coordinates."""
        return self.robot.nv

    def _scalars(self, values: torch.Tensor, scale: float = 1.0) -> Scalars:
        """The numbers, with 0.0 for what is rounding beside ``scale``."""
        values = values.detach().cpu()
        return scalars(torch.where(values.abs() <= ROUNDING * scale, 0.0, values).tolist())


def scalars(values: list) -> Scalars:
    """Nested lists of floats and expressions as an array."""
    return np.array(values, dtype=object)


def expressions(graph: Graph, nodes: torch.Tensor) -> Scalars:
    """Nodes as scalars of the same shape; what is known as floats."""
    known = [graph.value(node) for node in nodes.flatten().tolist()]
    pairs = zip(known, nodes.flatten().tolist(), strict=True)
    return scalars([Expression(graph, node) if x is None else x for x, node in pairs]).reshape(nodes.shape)


class UnrolledKinematics:
    """The rigid-body algorithms at given states, as arrays of scalars in the units of `Robot`; `v` only if needed."""

    def __init__(self, unrolled: UnrolledRobot, q: _Values, v: _Values | None = None) -> None:
        self.unrolled = unrolled
        self.v = None if v is None else self._of_bodies(v)
        self.rotations: list[Scalars] = []  # body axes -> parent's axes
        self.origins: list[Scalars] = []  # body's origin in the parent's frame
        for i, joint in enumerate(unrolled.joints):
            if len(joint.rows) > 1:
                if i == joint.rows[0]:
                    rotation, origin = _pose(q[joint.positions])
                    self.rotations += [joint.rotation @ rotation] * len(joint.rows)
                    self.origins += [joint.origin + joint.rotation @ origin] * len(joint.rows)
                continue
            (position,) = q[joint.positions]
            if unrolled.coupled:
                position = position * joint.drive.multiplier + joint.drive.offset
            if joint.revolute:
                c, s = position.cos(), position.sin()
                self.rotations.append(joint.rotation @ scalars([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
                self.origins.append(joint.origin)
            else:
                self.rotations.append(joint.rotation)
                self.origins.append(joint.origin + joint.rotation[:, 2] * position)

    def mass_matrix(self) -> Scalars:
        """Mass matrix (nv, nv), armature on the diagonal; 0.0 between joints of different branches."""
        joints, n = self.unrolled.joints, len(self.unrolled.joints)
        composite = list(self.unrolled.inertias)
        for i in reversed(range(n)):
            if joints[i].parent != WORLD and i == joints[i].rows[-1]:
                composite[joints[i].parent] = composite[joints[i].parent] + self._inertia_in_parent(i, composite[i])
        M = scalars([[0.0] * n for _ in range(n)])
        for j in range(n):
            i = joints[j].rows[-1]
            force, moment = _momentum(composite[i], joints[j].axis)
            while True:
                for k in joints[i].rows:
                    if k <= j:
                        M[k, j] = M[j, k] = _along(joints[k], force, moment)
                if joints[i].parent == WORLD:
                    break
                force, moment = self._wrench_in_parent(i, force, moment)
                i = joints[i].parent
        M = self._of_joints(self._of_joints(M).T).T
        M[np.diag_indices(len(M))] = M.diagonal() + self.unrolled.armature
        return M

    def bias_forces(self) -> Scalars:
        """Coriolis, centrifugal and gravity forces (nv,): the tau that gives zero acceleration."""
        return self._joint_forces(self.v, None)

    def inverse_dynamics(self, a: Scalars) -> Scalars:
        """Joint forces (nv,) that give the accelerations ``a``: ``M a + bias``."""
        return self._joint_forces(self.v, self._of_bodies(a)) + self.unrolled.armature * a

    def gravity_forces(self) -> Scalars:
        """Joint forces (nv,) that hold the robot still."""
        return self._joint_forces([0.0] * len(self.unrolled.joints), None)

    def _of_bodies(self, values: _Values) -> Any:
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

    def _accelerations(self, v: _Values, a: _Values | None) -> list[Scalars]:
        """Accelerations A (3, 4) of all bodies at joint accelerations ``a`` (0 if None), less that of free fall."""
        base = scalars([[0.0, 0.0, 0.0, -g] for g in self.unrolled.gravity])
        w: list[Scalars] = []
        dw: list[Scalars] = []
        A: list[Scalars] = []
        for i, joint in enumerate(self.unrolled.joints):
            if i != joint.rows[-1]:
                for of_bodies in (w, dw, A):
                    of_bodies.append(scalars([]))
                continue
            to_body = self.rotations[i].T
            above = base if joint.parent == WORLD else A[joint.parent]
            acceleration = to_body @ (above[:, :3] @ self.origins[i] + above[:, 3])
            if joint.parent == WORLD:
                wi = dwi = scalars([0.0] * 3)
            else:
                wi, dwi = to_body @ w[joint.parent], to_body @ dw[joint.parent]
            (moved, turned), own = self._six(joint, v), self._six(joint, a)
            acceleration = acceleration + np.cross(2.0 * wi + turned, moved) + own[0]
            w.append(wi + turned)
            dw.append(dwi + np.cross(wi, turned) + own[1])
            A.append(np.column_stack([_turning(w[i], dw[i]), acceleration]))
        return A

    def _joint_forces(self, v: _Values | None, a: _Values | None) -> Scalars:
        assert v is not None, "forces that depend on velocities need some"
        joints, n = self.unrolled.joints, len(self.unrolled.joints)
        forces, moments = ([scalars([0.0] * 3) for _ in range(n)] for _ in range(2))
        out = [0.0] * n
        accelerations = self._accelerations(v, a)
        for i in reversed(range(n)):
            if i != joints[i].rows[-1]:
                continue
            F = accelerations[i] @ self.unrolled.inertias[i]
            force = forces[i] + F[:, 3]
            moment = moments[i] + scalars([F[x, y] - F[y, x] for x, y in ((2, 1), (0, 2), (1, 0))])
            for k in joints[i].rows:
                out[k] = _along(joints[k], force, moment)
            parent = joints[i].parent
            if parent != WORLD:
                force, moment = self._wrench_in_parent(i, force, moment)
                forces[parent], moments[parent] = forces[parent] + force, moments[parent] + moment
        return self._of_joints(scalars(out))

    def _six(self, joint: UnrolledJoint, values: _Values | None) -> list[Scalars]:
        """Linear and angular entries (3,) of ``values`` along the axes of a joint; 0 if None."""
        six = scalars([0.0] * 6)
        if values is not None:
            for k in joint.rows:
                six[self.unrolled.joints[k].axis] = values[k]
        return [six[:3], six[3:]]

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


def _pose(q: Any) -> tuple[Scalars, Scalars]:
    """Rotation (3, 3) and translation (3,) of a floating joint, by the code of the robot's."""
    example = torch.tensor(NEUTRAL, dtype=torch.float64)
    _, (rotation, origin) = trace(pose, [example], q[0].graph, list(q))
    return expressions(q[0].graph, rotation), expressions(q[0].graph, origin)


def _momentum(P: Scalars, axis: int) -> tuple[Scalars, Scalars]:
    """Force and moment (3,) of a body of pseudo-inertia P under a unit of acceleration along one of the six axes."""
    k = axis % 3
    i, j, h = (k + 1) % 3, (k + 2) % 3, P[:3, 3]
    force, moment = scalars([0.0] * 3), scalars([0.0] * 3)
    if axis < 3:
        force[k], moment[i], moment[j] = P[3, 3], h[j], -h[i]
    else:
        force[i], force[j] = -h[j], h[i]
        moment[i], moment[j], moment[k] = -P[i, k], -P[j, k], P[i, i] + P[j, j]
    return force, moment


def _along(joint: UnrolledJoint, force: Scalars, moment: Scalars) -> Any:
    return moment[joint.axis - 3] if joint.revolute else force[joint.axis]


def symmetric(lower: Scalars) -> Scalars:
    """The full matrix of a lower triangle; what is above it is not read."""
    rows, columns = np.indices(lower.shape)
    return lower[np.maximum(rows, columns), np.minimum(rows, columns)]


def factorize(matrix: Scalars) -> tuple[Scalars, Scalars]:
    """L (unit lower triangle) and D of ``matrix = L^T D L``, from the last row; reads the lower triangle.

    Featherstone's LTDL, table 6.3: parents stand before children, so nothing fills in for a mass matrix.
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


INSTEAD = "use the robot itself (compiled.robot), whose results are the same"
# Arguments of each function, and the shapes of its results in joints.
ARGUMENTS = {
    "mass_matrix": ("q",),
    "bias_forces": ("q", "v"),
    "mass_matrix_and_bias": ("q", "v"),
    "gravity_forces": ("q",),
    "inverse_dynamics": ("q", "v", "a"),
    "forward_dynamics": ("q", "v", "tau"),
}
DIMENSIONS = {"mass_matrix": (2,), "mass_matrix_and_bias": (2, 1)}


def trace_dynamics(unrolled: UnrolledRobot, function: str) -> Program:
    """Write a function of the robot down."""
    graph = Graph()
    inputs = {name: unrolled.robot.nq if name == "q" else unrolled.nv for name in ARGUMENTS[function]}
    given = {name: scalars(graph.more_inputs(size)) for name, size in inputs.items()}
    at = UnrolledKinematics(unrolled, given["q"], given.get("v"))
    positive = scalars([])
    if function == "forward_dynamics":
        L, positive = factorize(at.mass_matrix())
        made = [solve_factorized(L, 1.0 / positive, given["tau"] - at.bias_forces())]
    elif function == "inverse_dynamics":
        made = [at.inverse_dynamics(given["a"])]
    else:
        names = ("mass_matrix", "bias_forces") if function == "mass_matrix_and_bias" else (function,)
        made = [getattr(at, name)().ravel() for name in names]

    def nodes(array: Iterable[Any]) -> list[int]:
        return [node_of(graph, scalar) for scalar in array]

    return Program(graph, inputs, {f"result {k}": nodes(result) for k, result in enumerate(made)}, nodes(positive))


class CompiledRobot(RigidBodyDynamics):
    """The dynamics of a robot, compiled for it at the first call; made by ``robot.compile()``.

    Methods take, check and return what those of `Robot` do, to rounding. InvalidInput for derivatives, transforms of
    ``torch.func`` and other devices than the CPU; CompilerError where something must be compiled and no C compiler is
    there. Code is kept in ``folder`` (``~/.cache/forcegp/compiled`` by default) and runs with the rights of the
    process.
    """

    def __init__(self, robot: RobotStructure, folder: str | Path | None = None) -> None:
        if robot.device.type != "cpu":
            raise InvalidInput(
                f"compiled dynamics runs on the CPU, and the robot is on {robot.device}; compile robot.to('cpu'), or "
                "use the robot itself."
            )
        self.robot = robot
        self.folder = default_folder() if folder is None else Path(folder).expanduser()
        self._unrolled = UnrolledRobot(robot)
        self._nv, self._space = robot.nv, robot.space
        self._programs: dict[str, RowFunction] = {}

    def __reduce__(self) -> "tuple[type[CompiledRobot], tuple[RobotStructure, Path]]":
        return CompiledRobot, (self.robot, self.folder)

    def __repr__(self) -> str:
        return f"CompiledRobot({self.robot!r}, folder={str(self.folder)!r})"

    def program(self, function: str) -> RowFunction:
        """The machine code of a function."""
        if function not in self._programs:
            unrolled, nv = self._unrolled, self._nv

            def write(lanes: int) -> str:
                return write_program(trace_dynamics(unrolled, function), lanes)

            name = f"{self.robot.name[:40]}-{function}"
            library = load_library(name, f"{unrolled.constants!r}\0{function}", write, folder=self.folder)
            outputs = [nv**d for d in DIMENSIONS.get(function, (1,))]
            self._programs[function] = RowFunction(library, len(ARGUMENTS[function]), outputs)
        return self._programs[function]

    @override
    def _dynamics(self, function: str, *arguments: Tensor) -> Any:
        nv, given, names = self._nv, list(arguments), ARGUMENTS[function]
        plain = self._are_possible(given) if self._space.groups else are_plain(given, nv)
        if not plain:
            given = [self.robot.checked_input(name, value) for name, value in zip(names, given, strict=True)]
            if torch.is_grad_enabled() and any(value.requires_grad for value in given):
                raise InvalidInput(f"compiled dynamics has no derivatives; {INSTEAD}.")
        require_plain(given, "compiled dynamics", INSTEAD)
        batch, program = given[0].shape[:-1], self.program(function)
        if plain and not batch:
            bits, results = program.single(*given)
        else:
            if not plain:
                batch = broadcast_batch({name: value.shape[:-1] for name, value in zip(names, given, strict=True)})
                given = [value.expand(*batch, value.shape[-1]) for value in given]
            if not plain or len(batch) != 1:
                given = [value.reshape(batch.numel(), value.shape[-1]).contiguous() for value in given]
            results = [torch.empty(batch.numel(), size, dtype=torch.float64) for size in program.outputs]
            bits = program.rows(batch.numel(), given, results)
        if bits & NOT_POSITIVE:
            raise NumericalError(NOT_POSITIVE_DEFINITE)
        made = zip(results, DIMENSIONS.get(function, (1,)), strict=True)
        found = [x if d == len(batch) == 1 else x.view(*batch, *(nv,) * d) for x, d in made]
        return found[0] if len(found) == 1 else tuple(found)

    def _are_possible(self, given: Sequence[Tensor]) -> bool:
        """`are_plain` where q has more entries than v and a length to check."""
        q, *others = given
        plain = are_plain([q], self._space.nq) and are_plain(others, self._nv)
        if plain and all(x.shape[:-1] == q.shape[:-1] for x in others):
            self._space.check(q)
            return True
        return False
