"""The dynamics of one robot, and their derivatives, as programs: straight-line arithmetic from inputs to outputs.

Derivatives of forward dynamics ``a = M^-1 (tau - bias)`` do not go through the factorisation. With ``l = M^-1 g`` for
the cotangent g of a,

    d <g, a> = <l, dtau> - d <l, ID(q, v, a)>  with l and a held,

so that beyond the accelerations themselves they cost one more solution with the same factor and the derivative of
inverse dynamics ID (implicit differentiation; Carpentier & Mansard, "Analytical derivatives of rigid body dynamics
algorithms", RSS 2018). The factor and the accelerations are "kept" by the program of the value, if it is asked to.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from forcegp.codegen.c_writer import Program, write_program
from forcegp.codegen.derivatives import gradients
from forcegp.codegen.graph import Graph, node_of
from forcegp.codegen.library import Purpose, RowFunction, VectorUnit, load_library
from forcegp.robots.unrolled import UnrolledKinematics, UnrolledRobot, factorize, scalars, solve_factorized

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

KEPT = "kept"
"""L below its diagonal and the inverse of D, where ``M = L^T D L``, and the accelerations."""

KEEPING = "forward_dynamics"
"""The function whose value is more than half of its derivatives."""


class Request(NamedTuple):
    """Which program: a function of the robot, or its derivatives in all arguments.

    ``keeps``: the value of forward dynamics with what its derivatives take.
    """

    function: str
    derivatives: bool = False
    keeps: bool = False

    @property
    def results(self) -> dict[str, int]:
        """Names of the results of the function, and of their cotangents, and how many dimensions of joints each has."""
        return {f"result {k}": d for k, d in enumerate(DIMENSIONS.get(self.function, (1,)))}

    def sizes(self, unrolled: UnrolledRobot) -> tuple[dict[str, int], dict[str, int]]:
        """Lengths of what the program takes and makes, by name and in order.

        Derivatives take the arguments, what was kept and the cotangents of the results.
        """
        nv = unrolled.nv
        arguments = {name: unrolled.robot.nq if name == "q" else nv for name in ARGUMENTS[self.function]}
        results = {name: nv**d for name, d in self.results.items()}
        kept = {KEPT: len(unrolled.pairs) + 2 * nv}
        if self.derivatives:
            return arguments | (kept if self.function == KEEPING else {}) | results, arguments
        return arguments, results | (kept if self.keeps else {})


def trace_dynamics(unrolled: UnrolledRobot, request: Request) -> Program:
    """Write a program down."""
    inputs, outputs = request.sizes(unrolled)
    graph = Graph()
    given = {name: scalars(graph.more_inputs(size)) for name, size in inputs.items()}
    at = UnrolledKinematics(unrolled, given["q"], given.get("v"))
    held, made, positive = [], [], scalars([])
    if request.function != KEEPING:
        names = ("mass_matrix", "bias_forces") if request.function == "mass_matrix_and_bias" else (request.function,)
        a = [given["a"]] if "a" in given else []
        made = [getattr(at, name)(*a).ravel() for name in names]
    elif request.derivatives:  # [l, a] are held, and inverse dynamics taken at a
        L, pairs, kept = scalars(np.eye(unrolled.nv).tolist()), len(unrolled.pairs), given[KEPT]
        for pair, entry in zip(unrolled.pairs, kept, strict=False):
            L[pair] = entry
        inverse, a = kept[pairs : -unrolled.nv], kept[-unrolled.nv :]
        held = [solve_factorized(L, inverse, given["result 0"]), a]
        made = [at.inverse_dynamics(a)]
    else:
        L, positive = factorize(at.mass_matrix())
        inverse = 1.0 / positive
        a = solve_factorized(L, inverse, given["tau"] - at.bias_forces())
        made = [a, np.concatenate([[L[pair] for pair in unrolled.pairs], inverse, a])][: len(outputs)]

    def nodes(*arrays: Iterable[Any]) -> list[int]:
        return [node_of(graph, scalar) for array in arrays for scalar in array]

    if not request.derivatives:
        vectors = {name: nodes(result) for name, result in zip(outputs, made, strict=True)}
        return Program(graph, inputs, vectors, nodes(positive))
    wanted = {name: nodes(given[name]) for name in outputs if name != "tau"}
    after = nodes(-held[0]) if held else nodes(*(given[name] for name in request.results))
    found = iter(gradients(graph, nodes(*made), after, [x for v in wanted.values() for x in v], nodes(*held)))
    vectors = {name: [next(found) for _ in vector] for name, vector in wanted.items()}
    if "tau" in outputs:
        vectors["tau"] = nodes(held[0])
    return Program(graph, inputs, {name: vectors[name] for name in outputs})


PURPOSE = Purpose("compiled dynamics", "robot.compile(folder=...)", "use the robot itself")


def compiled_program(unrolled: UnrolledRobot, request: Request, folder: Path) -> RowFunction:
    """From ``folder`` if it is there, else compiled into it. Raises CompilerError as `load_library`."""

    def write(unit: VectorUnit) -> str:
        return write_program(trace_dynamics(unrolled, request), unit.lanes)

    constants: list[object] = [(joint.parent, joint.axis, joint.kind, *joint.drive) for joint in unrolled.joints]
    constants += [x.tolist() for joint in unrolled.joints for x in (joint.rotation, joint.origin)]
    constants += [unrolled.gravity.tolist(), unrolled.armature.tolist(), [body.tolist() for body in unrolled.inertias]]
    key = f"{constants!r}\0{request!r}"
    library, _ = load_library(f"{unrolled.robot.name[:40]}-{request.function}", key, write, folder, PURPOSE)
    return RowFunction(library, *(list(sizes.values()) for sizes in request.sizes(unrolled)))
