"""The dynamics of a robot by CasADi: scalar C that it generates, compiled with `gcc -O3 -march=native`, a loop in C.

Two forms of each quantity, of which a comparison takes the faster: "direct" is recursive Newton-Euler, composite rigid
bodies and LDL' written with CasADi's own operations, "graph" what forcegp traces for its own code, as CasADi
expressions. Both go through `casadi.cse`. The gradient of sum(w * a) with respect to the ten standard parameters of
every body comes with the accelerations from one function, and takes the implicit derivative (`-l' ID(q, v, a)`, with
``l = M^-1 w`` and a held), which is cheaper than CasADi's through the factorisation.
"""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from forcegp.models.casadi_export import expressed
from forcegp.robots import Robot
from forcegp.robots.dynamics_programs import Request, trace_dynamics
from forcegp.robots.unrolled import UnrolledRobot

QUANTITIES = ("mass_bias", "fd", "inertial_gradient")
SUMMED = "inertial_gradient"


class Rivals:
    """Loops over states, by quantity and form; results in the array ``out`` of a call."""

    def __init__(self, robot: Robot, folder: Path) -> None:
        self.unrolled, self.folder, self.nv = UnrolledRobot(robot), folder, robot.nv
        self.standard = standard_parameters(self.unrolled)
        self.functions = {
            (quantity, form): self._compiled(quantity, form)
            for quantity in QUANTITIES
            for form in ("direct", "graph")
        }

    def loops(self, quantity: str, q: np.ndarray, v: np.ndarray, *more: np.ndarray) -> dict[str, Callable[[], Any]]:
        """By form: a function that fills and returns the results, two arrays; those of a gradient are summed up."""
        count = len(q)
        found = {}
        for form in ("direct", "graph"):
            loop, sizes = self.functions[quantity, form]
            given = [np.ascontiguousarray(x) for x in (q, v, *more)]
            if quantity == SUMMED:
                given.insert(3, self.standard[form])
            results = [np.zeros((count, size)) for size in sizes]
            if quantity == SUMMED:
                results[1] = np.zeros(sizes[1])
            pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in (*given, *results)]

            def call(loop: Any = loop, pointers: list = pointers, held: list = given, results: list = results) -> list:
                loop(ctypes.c_long(count), *pointers)
                return results

            found[form] = call
        return found

    def _compiled(self, quantity: str, form: str) -> tuple[Any, list[int]]:
        inputs, outputs = getattr(self, f"_{form}")(quantity)
        name = f"{quantity}_{form}"
        function = ca.Function("f", inputs, ca.cse(outputs))
        source = self.folder / f"{name}.c"
        code = ca.CodeGenerator(f"{name}.c")
        code.add(function)
        code.generate(f"{self.folder}/")
        ins = [x.numel() for x in inputs]
        outs = [x.numel() for x in outputs]
        steps = [0 if quantity == SUMMED and k == 3 else size for k, size in enumerate(ins)]
        arguments = [f"const double *a{k}" for k in range(len(ins))] + [f"double *o{k}" for k in range(len(outs))]
        rows = [f"arg[{k}] = a{k} + i * {step};" for k, step in enumerate(steps)]
        summed = quantity == SUMMED
        rows += [
            f"res[{k}] = {'sum' if summed and k == 1 else f'o{k} + i * {size}'};" for k, size in enumerate(outs)
        ]
        add = f"for (int j = 0; j < {outs[1]}; j++) o1[j] += sum[j];" if summed else ""
        clear = f"for (int j = 0; j < {outs[1]}; j++) o1[j] = 0.0;" if summed else ""
        source.write_text(
            source.read_text()
            + f"""
void loop(long n, {", ".join(arguments)}) {{
  static double w[{max(function.sz_w(), 1)}], sum[1024];
  const double *arg[{max(function.sz_arg(), 1)}];
  double *res[{max(function.sz_res(), 1)}];
  casadi_int iw[{max(function.sz_iw(), 1)}];
  {clear}
  for (long i = 0; i < n; i++) {{ {" ".join(rows)} f(arg, res, iw, w, 0); {add} }}
}}
"""
        )
        library = source.with_suffix(".so")
        command = ["gcc", "-O3", "-march=native", "-fPIC", "-shared", str(source), "-o", str(library), "-lm"]
        subprocess.run(command, check=True, capture_output=True)
        return ctypes.CDLL(str(library)).loop, outs

    def _graph(self, quantity: str) -> tuple[list, list]:
        requests = {
            "mass_bias": [Request("mass_matrix_and_bias")],
            "fd": [Request("forward_dynamics")],
            SUMMED: [Request("forward_dynamics", True), Request("forward_dynamics", True, False, True)],
        }[quantity]
        programs = [trace_dynamics(self.unrolled, request) for request in requests]
        inputs = [ca.SX.sym(name, size) for name, size in programs[-1].inputs.items()]
        given = ca.vertsplit(ca.vertcat(*inputs))
        return inputs, [
            ca.vertcat(*expressed(ca, program.graph, list(nodes), given))
            for program in programs
            for nodes in program.outputs.values()
        ]

    def _direct(self, quantity: str) -> tuple[list, list]:
        q, v, tau, w = (ca.SX.sym(name, self.nv) for name in ("q", "v", "tau", "w"))
        standard = ca.SX.sym("standard", 10, self.nv)
        known = ca.SX(ca.sparsify(ca.DM(self.standard["direct"].T)))
        parameters = standard if quantity == SUMMED else known
        M, bias = self._mass_matrix(q, parameters), self._inverse_dynamics(q, v, None, parameters)
        if quantity == "mass_bias":
            return [q, v], [ca.densify(ca.vec(M)), bias]
        D, LT, permutation = ca.ldl(M)
        a = ca.ldl_solve(tau - bias, D, LT, permutation)
        if quantity == "fd":
            return [q, v, tau], [a]
        multiplier, there = ca.ldl_solve(w, D, LT, permutation), ca.SX.sym("there", 2 * self.nv)
        power = ca.dot(there[: self.nv], self._inverse_dynamics(q, v, there[self.nv :], parameters))
        slope = ca.substitute(-ca.gradient(power, standard), there, ca.vertcat(multiplier, a))
        return [q, v, tau, ca.vec(standard), w], [a, ca.vec(slope)]

    def _poses(self, q: Any) -> list[tuple[Any, Any]]:
        """Body axes to the parent's, and the body's origin there."""
        poses = []
        for k, joint in enumerate(self.unrolled.joints):
            c, s = ca.cos(q[k]), ca.sin(q[k])
            turn = ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))
            fixed = ca.SX(ca.sparsify(ca.DM(joint.rotation.astype(float))))
            poses.append((fixed @ turn, ca.SX(ca.DM(joint.origin.astype(float)))))
        return poses

    def _inverse_dynamics(self, q: Any, v: Any, a: Any, parameters: Any) -> Any:
        poses, axis, n = self._poses(q), ca.SX(ca.DM([0, 0, 1])), self.nv
        w, dw, linear = ca.SX.zeros(3), ca.SX.zeros(3), -ca.SX(ca.DM(self.unrolled.gravity.astype(float)))
        wrenches = []
        for k, (R, p) in enumerate(poses):  # a chain: the parent of each is the one before
            linear = R.T @ (linear + ca.cross(dw, p) + ca.cross(w, ca.cross(w, p)))
            w, dw = R.T @ w, R.T @ dw
            dw = dw + ca.cross(w, axis * v[k]) + (0 if a is None else axis * a[k])
            w = w + axis * v[k]
            mass, first, inertia = _body(parameters[:, k])
            force = mass * linear + ca.cross(dw, first) + ca.cross(w, ca.cross(w, first))
            wrenches.append((force, inertia @ dw + ca.cross(w, inertia @ w) + ca.cross(first, linear)))
        out = [ca.SX(0)] * n
        force, moment = ca.SX.zeros(3), ca.SX.zeros(3)
        for k in reversed(range(n)):
            force, moment = force + wrenches[k][0], moment + wrenches[k][1]
            out[k] = moment[2] + (0 if a is None else float(self.unrolled.armature[k]) * a[k])
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
            turned, arm = R @ first, None
            arm = turned + 0.5 * mass * p
            inertia = R @ inertia @ R.T + 2 * ca.dot(arm, p) * ca.SX.eye(3) - arm @ p.T - p @ arm.T
            first = turned + mass * p
        return M


def _body(p: Any) -> tuple[Any, Any, Any]:
    """Mass, first moment and inertia about the joint."""
    rows = ca.horzcat(p[4], p[5], p[7]), ca.horzcat(p[5], p[6], p[8]), ca.horzcat(p[7], p[8], p[9])
    return p[0], p[1:4], ca.vertcat(*rows)


def standard_parameters(unrolled: UnrolledRobot) -> dict[str, np.ndarray]:
    """Of all bodies, by form: [m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz], and the pseudo-inertia's upper triangle."""
    pseudo = np.stack([body.astype(float) for body in unrolled.inertias])
    second = pseudo[:, :3, :3]
    inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    rows, columns = [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]
    direct = np.hstack([pseudo[:, 3, 3, None], pseudo[:, :3, 3], inertia[:, rows, columns]])
    return {"direct": np.ascontiguousarray(direct), "graph": np.ascontiguousarray(pseudo[:, *np.triu_indices(4)])}
