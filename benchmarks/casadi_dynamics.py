"""The dynamics of a robot by CasADi: scalar C that it generates, compiled with `gcc -O3 -march=native`, a loop in C.

What forcegp traces for its own code, as CasADi's scalar expressions (SX), with `casadi.cse`. Recursive Newton-Euler and
composite rigid bodies in body axes, written by hand, have half as many operations.
"""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as untyped
import numpy as np

from forcegp.posterior.casadi_export import expressed
from forcegp.robots import Robot
from forcegp.robots.compiled import trace_dynamics

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
        self.robot, self.folder = robot, folder
        self.mass_bias = self._loop("mass_bias", "mass_matrix_and_bias", q, v)
        self.fd = self._loop("fd", "forward_dynamics", q, v, tau)

    def _loop(self, quantity: str, traced: str, *given: np.ndarray) -> Callable[[], list[np.ndarray]]:
        program = trace_dynamics(self.robot, traced)
        inputs = [ca.SX.sym(name, size) for name, size in program.inputs.items()]
        entries = [entry for vector in inputs for entry in ca.vertsplit(vector)]
        outputs = [ca.vertcat(*expressed(ca, program.graph, nodes, entries)) for nodes in program.outputs.values()]
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
