"""The rigid-body algorithms of one robot, unrolled into scalars, at given states.

Body frames have their joint along z (:mod:`forcegp.robots.layout`), so that in body axes a joint is a rotation by q
about z. Quantities of body i are written in its own axes about its own origin. With w, w' and a the angular velocity,
angular acceleration and acceleration of the origin, and P the pseudo-inertia,

    A = [[w']x + [w]x [w]x, a]  (3 x 4),  F = A P,  force f = F[:, 3],  moment n = (F21 - F12, F02 - F20, F10 - F01)

which is the recursive Newton-Euler algorithm; the mass matrix is the composite-rigid-body algorithm, whose column j is
the wrench of the composite body under A of one unit of joint j (Featherstone, "Rigid Body Dynamics Algorithms", 2008,
ch. 5 and 6), carried to the joints above. Being linear in P, both are polynomials of degree one in the inertias.
"""

from __future__ import annotations

from collections.abc import Sequence

from forcegp.errors import InvalidInput
from forcegp.robots.layout import WORLD
from forcegp.robots.scalar_algebra import (
    Matrix,
    Scalar,
    Vector,
    add,
    apply,
    cosine,
    cross,
    dot,
    factorize,
    minus,
    multiply,
    negate,
    plus,
    product,
    sine,
    solve_factorized,
    subtract,
    symmetric,
    symmetric_product,
    transpose,
)
from forcegp.robots.unrolled import UnrolledRobot

Inertias = Sequence[Sequence[Sequence[Scalar]]]


class UnrolledKinematics:
    """The rigid-body algorithms at given states; one scalar per joint; ``v`` only if they are needed.

    A joint position or velocity given as a float is a constant: 0.0 drops out.

    All results are scalars or nested lists of scalars, in the units of :class:`~forcegp.robots.Robot`. ``inertias`` is
    one symmetric 4x4 pseudo-inertia (nested list; kg m^2, kg m, kg) per body in body axes, in place of the robot's. An
    entry that is structurally zero is the float 0.0, not a tensor.
    """

    def __init__(self, unrolled: UnrolledRobot, q: Sequence[Scalar], v: Sequence[Scalar] | None = None) -> None:
        for name, values in (("q", q), ("v", v)):
            if values is not None and len(values) != unrolled.nv:
                raise InvalidInput(
                    f"{name} holds {len(values)} scalars; {unrolled.robot.name} has {unrolled.nv} joints, give one "
                    f"each, such as {name}.unbind(-1)."
                )
        self.unrolled = unrolled
        self.v = None if v is None else list(v)
        self.rotations: list[Matrix] = []  # body axes -> parent's axes
        self.origins: list[Vector] = []  # body's origin in the parent's frame
        self._world_rotations: dict[int, Matrix] = {}
        for joint, position in zip(unrolled.joints, q, strict=True):
            if joint.revolute:
                c, s = cosine(position), sine(position)
                turn = [[c, negate(s), 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
                self.rotations.append(product(joint.rotation, turn))
                self.origins.append(list(joint.origin))
            else:
                self.rotations.append([list(row) for row in joint.rotation])
                slide = [multiply(row[2], position) for row in joint.rotation]
                self.origins.append(plus(joint.origin, slide))

    # ------------------------------------------------------------------ dynamics

    def mass_matrix(self, inertias: Inertias | None = None) -> Matrix:
        """Mass matrix (nv, nv), armature on the diagonal; 0.0 between joints of different branches."""
        joints, n = self.unrolled.joints, self.unrolled.nv
        composite = [[list(row) for row in body] for body in self._inertias(inertias)]
        for i in reversed(range(n)):
            parent = joints[i].parent
            if parent != WORLD:
                moved = self._inertia_in_parent(i, composite[i])
                composite[parent] = [plus(*rows) for rows in zip(composite[parent], moved, strict=True)]
        M: Matrix = [[0.0] * n for _ in range(n)]
        for j in range(n):
            P = composite[j]
            hx, hy = P[0][3], P[1][3]
            if joints[j].revolute:
                force = [negate(hy), hx, 0.0]
                moment = [negate(P[0][2]), negate(P[1][2]), add(P[0][0], P[1][1])]
            else:
                force, moment = [0.0, 0.0, P[3][3]], [hy, negate(hx), 0.0]
            i = j
            while True:
                M[i][j] = M[j][i] = moment[2] if joints[i].revolute else force[2]
                if joints[i].parent == WORLD:
                    break
                force, moment = self._wrench_in_parent(i, force, moment)
                i = joints[i].parent
            M[j][j] = add(M[j][j], self.unrolled.armature[j])
        return M

    def bias_forces(self, inertias: Inertias | None = None) -> Vector:
        """Coriolis, centrifugal and gravity forces (nv,): the tau that gives zero acceleration."""
        return self._joint_forces(self._accelerations(self._velocities("bias_forces")), inertias)

    def inverse_dynamics(self, a: Sequence[Scalar], inertias: Inertias | None = None) -> Vector:
        """Joint forces (nv,) that give the accelerations ``a``: ``M a + bias``."""
        forces = self._joint_forces(self._accelerations(self._velocities("inverse_dynamics"), a), inertias)
        return [add(f, multiply(r, x)) for f, r, x in zip(forces, self.unrolled.armature, a, strict=True)]

    def gravity_forces(self, inertias: Inertias | None = None) -> Vector:
        """Joint forces (nv,) that hold the robot still."""
        return self._joint_forces(self._accelerations([0.0] * self.unrolled.nv), inertias)

    def forward_dynamics(self, tau: Sequence[Scalar], inertias: Inertias | None = None) -> Vector:
        """Accelerations (nv,) under the joint forces ``tau``: ``M^-1 (tau - bias)``, by the sparse ``L^T D L``."""
        bias = self.bias_forces(inertias)
        return solve_factorized(*factorize(self.mass_matrix(inertias)), minus(tau, bias))

    # ------------------------------------------------------------------ points

    def point(self, frame: str, point: Sequence[Scalar] | None = None) -> Vector:
        """World position (3,) in m of a ``point`` fixed in ``frame`` (3 scalars in m; by default its origin)."""
        body, position = self._in_body(frame, point)
        while body != WORLD:
            position = plus(apply(self.rotations[body], position), self.origins[body])
            body = self.unrolled.joints[body].parent
        return position

    def point_jacobian(self, frame: str, point: Sequence[Scalar] | None = None) -> Matrix:
        """Jacobian (3, nv) of :meth:`point`, world axes; 0.0 for joints that do not move the frame."""
        joints = self.unrolled.joints
        body, position = self._in_body(frame, point)
        columns: list[Vector] = [[0.0] * 3 for _ in joints]
        while body != WORLD:  # in the axes of each body that carries the point, then turned into the world's
            x, y, _ = position
            column = [negate(y), x, 0.0] if joints[body].revolute else [0.0, 0.0, 1.0]
            columns[body] = apply(self._world_rotation(body), column)
            position = plus(apply(self.rotations[body], position), self.origins[body])
            body = joints[body].parent
        return transpose(columns)

    def point_bias_acceleration(self, frame: str, point: Sequence[Scalar] | None = None) -> Vector:
        """Acceleration (3,) of :meth:`point` at zero joint acceleration, classical, without gravity, world axes."""
        v = self._velocities("point_bias_acceleration")
        body, position = self._in_body(frame, point)
        if body == WORLD:
            return [0.0, 0.0, 0.0]
        A = self._accelerations(v, gravity=[0.0, 0.0, 0.0])[body]
        return apply(self._world_rotation(body), [add(dot(row[:3], position), row[3]) for row in A])

    # ------------------------------------------------------------------ inside

    def _velocities(self, what: str) -> Vector:
        if self.v is None:
            raise InvalidInput(f"{what} needs velocities; make the kinematics with UnrolledKinematics(unrolled, q, v).")
        return self.v

    def _inertias(self, inertias: Inertias | None) -> Inertias:
        if inertias is None:
            return self.unrolled.inertias
        if len(inertias) != self.unrolled.nv:
            raise InvalidInput(
                f"inertias holds {len(inertias)} matrices; give one 4x4 per body, {self.unrolled.nv} in all."
            )
        return inertias

    def _accelerations(
        self, v: Vector, a: Sequence[Scalar] | None = None, gravity: Sequence[float] | None = None
    ) -> list[Matrix]:
        """Accelerations A (3, 4) of all bodies at joint accelerations ``a`` (0 if None), less that of free fall."""
        fall = self.unrolled.gravity if gravity is None else gravity
        base: Matrix = [[0.0, 0.0, 0.0, negate(g)] for g in fall]
        w: list[Vector] = []
        dw: list[Vector] = []
        A: list[Matrix] = []
        for i, joint in enumerate(self.unrolled.joints):
            to_body = transpose(self.rotations[i])
            above = base if joint.parent == WORLD else A[joint.parent]
            acceleration = apply(to_body, [add(dot(row[:3], self.origins[i]), row[3]) for row in above])
            if joint.parent == WORLD:
                wi, dwi = [0.0] * 3, [0.0] * 3
            else:
                wi, dwi = apply(to_body, w[joint.parent]), apply(to_body, dw[joint.parent])
            own = 0.0 if a is None else a[i]
            passing = [multiply(wi[1], v[i]), negate(multiply(wi[0], v[i]))]  # w x (z v), whose z is zero
            if joint.revolute:
                dwi = plus(dwi, [*passing, own])
                wi = [wi[0], wi[1], add(wi[2], v[i])]
            else:  # the term of Coriolis counts twice
                acceleration = plus(acceleration, [*(multiply(2.0, x) for x in passing), own])
            w.append(wi)
            dw.append(dwi)
            A.append([[*row, x] for row, x in zip(_turning(wi, dwi), acceleration, strict=True)])
        return A

    def _joint_forces(self, accelerations: list[Matrix], inertias: Inertias | None) -> Vector:
        joints, n = self.unrolled.joints, self.unrolled.nv
        forces: Matrix = [[0.0] * 3 for _ in range(n)]
        moments: Matrix = [[0.0] * 3 for _ in range(n)]
        out: Vector = [0.0] * n
        given = self._inertias(inertias)
        for i in reversed(range(n)):
            A, P = accelerations[i], transpose(given[i])
            entry = [[dot(A[row], P[column]) if row != column else 0.0 for column in range(4)] for row in range(3)]
            force = plus(forces[i], [row[3] for row in entry])
            turning = [subtract(entry[x][y], entry[y][x]) for x, y in ((2, 1), (0, 2), (1, 0))]
            moment = plus(moments[i], turning)
            out[i] = moment[2] if joints[i].revolute else force[2]
            parent = joints[i].parent
            if parent != WORLD:
                force, moment = self._wrench_in_parent(i, force, moment)
                forces[parent], moments[parent] = plus(forces[parent], force), plus(moments[parent], moment)
        return out

    def _wrench_in_parent(self, i: int, force: Vector, moment: Vector) -> tuple[Vector, Vector]:
        """Force and moment of body i about its origin, in the axes and about the origin of its parent body."""
        force = apply(self.rotations[i], force)
        return force, plus(apply(self.rotations[i], moment), cross(self.origins[i], force))

    def _inertia_in_parent(self, i: int, P: Sequence[Sequence[Scalar]]) -> Matrix:
        """Pseudo-inertia of body i in its parent's frame: ``T P T^T``, block by block."""
        R, p = self.rotations[i], self.origins[i]
        second = symmetric_product(product(R, [row[:3] for row in P[:3]]), R)
        first, mass = apply(R, [row[3] for row in P[:3]]), P[3][3]
        arm = plus(first, [multiply(multiply(0.5, mass), x) for x in p])
        lower = [
            [add(second[r][c], add(multiply(arm[r], p[c]), multiply(p[r], arm[c]))) for c in range(r + 1)]
            for r in range(3)
        ]
        return symmetric([*lower, [*plus(first, [multiply(mass, x) for x in p]), mass]])

    def _in_body(self, frame: str, point: Sequence[Scalar] | None) -> tuple[int, Vector]:
        """The body that carries a frame, and the point of the frame in that body's frame."""
        body, rotation, origin = self.unrolled.frame(frame)
        if point is None:
            return body, list(origin)
        if len(point) != 3:
            raise InvalidInput(f"point holds {len(point)} scalars; give x, y and z in m.")
        return body, plus(apply(rotation, point), origin)

    def _world_rotation(self, body: int) -> Matrix:
        if body not in self._world_rotations:
            parent, own = self.unrolled.joints[body].parent, self.rotations[body]
            self._world_rotations[body] = own if parent == WORLD else product(self._world_rotation(parent), own)
        return self._world_rotations[body]


def _turning(w: Vector, dw: Vector) -> Matrix:
    """``[w']x + [w]x [w]x`` (3, 3)."""
    (x, y, z), (dx, dy, dz) = w, dw
    xx, yy, zz = multiply(x, x), multiply(y, y), multiply(z, z)
    xy, xz, yz = multiply(x, y), multiply(x, z), multiply(y, z)
    return [
        [negate(add(yy, zz)), subtract(xy, dz), add(xz, dy)],
        [add(xy, dz), negate(add(xx, zz)), subtract(yz, dx)],
        [subtract(xz, dy), add(yz, dx), negate(add(xx, yy))],
    ]
