"""The dynamics of a robot by CasADi: scalar C that it generates, compiled with `gcc -O3 -march=native`, a loop in C.

Recursive Newton-Euler, composite rigid bodies and LDL' in CasADi's scalar expressions (SX) and operations, with
`casadi.cse`. (What forcegp traces for its own code, as CasADi expressions, takes as long: 0.9 to 1.03 times.) Serial
chains of revolute joints only.
"""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as untyped
import numpy as np

from forcegp.robots import Robot
from forcegp.robots.compiled import UnrolledRobot

ca: Any = untyped
QUANTITIES = ("mass_bias", "fd")
LOOP = """
void loop(long n, const double *const *a, double *const *o) {
  static double w[1 + SZ_W];
  const double *arg[1 + SZ_ARG];
  double *res[1 + SZ_RES];
  casadi_int iw[1 + SZ_IW];
  for (long i = 0; i < n; i++) {
    ROWS
    f(arg, res, iw, w, 0);
  }
}
"""


class CasadiLoops:
    """Loops over given states (count, nv); a call returns the results."""

    def __init__(self, robot: Robot, folder: Path, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> None:
        self.unrolled, self.folder, self.nv = UnrolledRobot(robot), folder, robot.nv
        self.standard = standard_parameters(self.unrolled)
        given = {"mass_bias": (q, v), "fd": (q, v, tau)}
        self.mass_bias, self.fd = (self._loop(name, *given[name]) for name in QUANTITIES)

    def _loop(self, quantity: str, *given: np.ndarray) -> Callable[[], list[np.ndarray]]:
        inputs, outputs = self._expressions(quantity)
        function = ca.Function("f", inputs, ca.cse(outputs))
        code = ca.CodeGenerator(f"{quantity}.c")
        code.add(function)
        code.generate(f"{self.folder}/")
        rows = [f"arg[{k}] = a[{k}] + i * {x.numel() if x.is_vector() else 0};" for k, x in enumerate(inputs)]
        rows += [f"res[{k}] = o[{k}] + i * {x.numel()};" for k, x in enumerate(outputs)]
        text = LOOP.replace("ROWS", "\n    ".join(rows))
        for size in ("sz_w", "sz_arg", "sz_res", "sz_iw"):
            text = text.replace(f"+ {size.upper()}]", f"+ {getattr(function, size)()}]")
        source = self.folder / f"{quantity}.c"
        source.write_text(source.read_text() + text)
        library = source.with_suffix(".so")
        command = ["gcc", "-O3", "-march=native", "-fPIC", "-shared", str(source), "-o", str(library), "-lm"]
        subprocess.run(command, check=True, capture_output=True)
        loop, count = ctypes.CDLL(str(library)).loop, len(given[0])
        held = [np.ascontiguousarray(x) for x in given]
        results = [np.zeros((count, x.numel())) for x in outputs]
        a, o = ((ctypes.c_void_p * len(x))(*(y.ctypes.data for y in x)) for x in (held, results))

        def call(held: list[np.ndarray] = held) -> list[np.ndarray]:  # which keeps the inputs alive
            loop(ctypes.c_long(count), a, o)
            return results

        return call

    def _expressions(self, quantity: str) -> tuple[list, list]:
        q, v, tau = (ca.SX.sym(name, self.nv) for name in ("q", "v", "tau"))
        parameters = ca.SX(ca.sparsify(ca.DM(self.standard.T)))
        M, bias = self._mass_matrix(q, parameters), self._bias(q, v, parameters)
        if quantity == "mass_bias":
            return [q, v], [ca.densify(ca.vec(M)), bias]
        D, LT, permutation = ca.ldl(M)
        return [q, v, tau], [ca.ldl_solve(tau - bias, D, LT, permutation)]

    def _poses(self, q: Any) -> list[tuple[Any, Any]]:
        """Body axes to the parent's, and the body's origin there."""
        poses = []
        for k, joint in enumerate(self.unrolled.joints):
            c, s = ca.cos(q[k]), ca.sin(q[k])
            turn = ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))
            fixed = ca.SX(ca.sparsify(ca.DM(joint.rotation.astype(float))))
            poses.append((fixed @ turn, ca.SX(ca.DM(joint.origin.astype(float)))))
        return poses

    def _bias(self, q: Any, v: Any, parameters: Any) -> Any:
        poses, axis, n = self._poses(q), ca.SX(ca.DM([0, 0, 1])), self.nv
        w, dw, linear = ca.SX.zeros(3), ca.SX.zeros(3), -ca.SX(ca.DM(self.unrolled.gravity.astype(float)))
        wrenches = []
        for k, (R, p) in enumerate(poses):  # a chain: the parent of each is the one before
            linear = R.T @ (linear + ca.cross(dw, p) + ca.cross(w, ca.cross(w, p)))
            w, dw = R.T @ w, R.T @ dw
            dw = dw + ca.cross(w, axis * v[k])
            w = w + axis * v[k]
            mass, first, inertia = _body(parameters[:, k])
            force = mass * linear + ca.cross(dw, first) + ca.cross(w, ca.cross(w, first))
            wrenches.append((force, inertia @ dw + ca.cross(w, inertia @ w) + ca.cross(first, linear)))
        out = [ca.SX(0)] * n
        force, moment = ca.SX.zeros(3), ca.SX.zeros(3)
        for k in reversed(range(n)):
            force, moment = force + wrenches[k][0], moment + wrenches[k][1]
            out[k] = moment[2]
            R, p = poses[k]
            force = R @ force
            moment = R @ moment + ca.cross(p, force)
        return ca.vertcat(*out)

    def _mass_matrix(self, q: Any, parameters: Any) -> Any:
        poses, n = self._poses(q), self.nv
        M = ca.SX(n, n)
        mass, first, inertia = ca.SX(0), ca.SX.zeros(3), ca.SX(3, 3)
        for k in reversed(range(n)):
            own = _body(parameters[:, k])
            mass, first, inertia = mass + own[0], first + own[1], inertia + own[2]
            force, moment = ca.vertcat(-first[1], first[0], 0), inertia[:, 2]
            for i in reversed(range(k + 1)):
                M[i, k] = M[k, i] = moment[2]
                force = poses[i][0] @ force
                moment = poses[i][0] @ moment + ca.cross(poses[i][1], force)
            M[k, k] += float(self.unrolled.armature[k])
            R, p = poses[k]
            turned = R @ first
            arm = turned + 0.5 * mass * p
            inertia = R @ inertia @ R.T + 2 * ca.dot(arm, p) * ca.SX.eye(3) - arm @ p.T - p @ arm.T
            first = turned + mass * p
        return M


def _body(p: Any) -> tuple[Any, Any, Any]:
    """Mass, first moment and inertia about the joint."""
    rows = ca.horzcat(p[4], p[5], p[7]), ca.horzcat(p[5], p[6], p[8]), ca.horzcat(p[7], p[8], p[9])
    return p[0], p[1:4], ca.vertcat(*rows)


def standard_parameters(unrolled: UnrolledRobot) -> np.ndarray:
    """Of all bodies (nv, 10): [m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz], about the joint, as Pinocchio orders them."""
    pseudo = np.stack([body.astype(float) for body in unrolled.inertias])
    second = pseudo[:, :3, :3]
    inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    rows, columns = [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]
    return np.hstack([pseudo[:, 3, 3, None], pseudo[:, :3, 3], inertia[:, rows, columns]])
