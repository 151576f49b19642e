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
import torch
from torch import Tensor

from forcegp.codegen.c_writer import Program, write_program
from forcegp.codegen.derivatives import gradients
from forcegp.codegen.graph import Expression, Graph, node_of
from forcegp.codegen.library import Purpose, RowFunction, VectorUnit, load_library
from forcegp.codegen.tracing import trace
from forcegp.robots.tree import merged_inertias
from forcegp.robots.unrolled import (
    Scalars,
    UnrolledKinematics,
    UnrolledRobot,
    expressions,
    factorize,
    scalars,
    solve_factorized,
)

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

KEPT = ("kept",)
"""L below its diagonal and the inverse of D, where ``M = L^T D L``, and the accelerations."""

KEEPING = "forward_dynamics"
"""The function whose value is more than half of its derivatives."""

MERGED = "merged_inertias"
"""The function from log-Cholesky parameters of links to the inertias of bodies, which the others take."""

# The ten different entries of a symmetric 4x4 pseudo-inertia, in the order in which programs take them.
INERTIA_ENTRIES = tuple((row, column) for row in range(4) for column in range(row, 4))
ROWS, COLUMNS = (list(entries) for entries in zip(*INERTIA_ENTRIES, strict=True))


class Request(NamedTuple):
    """Which program: a function of the robot, with the inertias as inputs or as constants, its value or derivatives.

    ``states`` and ``inertias`` choose the derivatives: those in all arguments, those in the inertias, both; the value
    if neither. ``links`` are those whose parameters `MERGED` takes. ``keeps``: the value of forward dynamics with what
    its derivatives take.
    """

    function: str
    free_inertias: bool = False
    states: bool = False
    inertias: bool = False
    links: tuple[str, ...] = ()
    keeps: bool = False

    @property
    def arguments(self) -> tuple[str, ...]:
        """Arguments of the function in the order in which the program takes them."""
        return self._states + (("inertias",) if self.free_inertias else ())

    @property
    def _states(self) -> tuple[str, ...]:
        return ("parameters",) if self.function == MERGED else ARGUMENTS[self.function]

    @property
    def inputs(self) -> tuple[str, ...]:
        """What the program takes: the arguments, for derivatives also what was kept and the results' cotangents."""
        if self.is_value:
            return self.arguments
        return self.arguments + (KEPT if self.function == KEEPING else ()) + self.results

    @property
    def results(self) -> tuple[str, ...]:
        """Names of the results of the function, and of their cotangents."""
        return tuple(f"result {k}" for k in range(len(DIMENSIONS.get(self.function, (1,)))))

    @property
    def outputs(self) -> tuple[str, ...]:
        """What the program makes, in order."""
        return self.results + (KEPT if self.keeps else ()) if self.is_value else self.wanted

    @property
    def wanted(self) -> tuple[str, ...]:
        """Arguments of which this is the derivative, in order."""
        states = self._states if self.states else ()
        return states + (("inertias",) if self.inertias else ())

    @property
    def is_value(self) -> bool:
        """Whether the program computes the function itself."""
        return not (self.states or self.inertias)

    def sizes(self, unrolled: UnrolledRobot) -> dict[str, int]:
        """Length of every input, result and derivative by name."""
        nv = unrolled.nv
        merged = len(INERTIA_ENTRIES) * len(unrolled.joints)
        results = [merged] if self.function == MERGED else [nv**d for d in DIMENSIONS.get(self.function, (1,))]
        given = {"inertias": merged, "parameters": 10 * len(self.links)}
        kept = dict.fromkeys(KEPT, len(unrolled.pairs) + 2 * nv)
        given |= {"q": unrolled.robot.nq}
        arguments = {name: given.get(name, nv) for name in self.arguments}
        return arguments | kept | dict(zip(self.results, results, strict=True))


def trace_dynamics(unrolled: UnrolledRobot, request: Request) -> Program:
    """Write a program down."""
    n, sizes = unrolled.nv, request.sizes(unrolled)
    inputs = {name: sizes[name] for name in request.inputs}
    graph = Graph()
    given = {name: graph.more_inputs(size) for name, size in inputs.items() if name in request.arguments}
    kept = scalars(graph.more_inputs(inputs["kept"])) if "kept" in inputs else None
    cotangents = [graph.more_inputs(inputs[name]) for name in request.results if not request.is_value]
    positive = scalars([])
    held: list[Scalars] = []
    results: list[Scalars] = []
    differentiated: list[Scalars] = []
    if request.function == MERGED:
        results = differentiated = [_merged(unrolled, request, graph, given["parameters"])]
    else:
        inertias = None
        if request.free_inertias:
            inertias = [scalars([[0.0] * 4 for _ in range(4)]) for _ in unrolled.joints]
            for body, P in enumerate(inertias):
                P[COLUMNS, ROWS] = P[ROWS, COLUMNS] = given["inertias"][10 * body : 10 * body + 10]
        at = UnrolledKinematics(unrolled, given["q"], given.get("v"))
        if request.function == KEEPING:  # for derivatives [l, a] are held, and inverse dynamics taken at a
            if kept is None:
                L, positive = factorize(at.mass_matrix(inertias))
                factor = L, 1.0 / positive
                a = solve_factorized(*factor, scalars(given["tau"]) - at.bias_forces(inertias))
                results = [a]
                if request.keeps:
                    results.append(np.concatenate([[L[pair] for pair in unrolled.pairs], factor[1], a]))
            else:
                L, pairs = scalars(np.eye(n).tolist()), len(unrolled.pairs)
                for pair, entry in zip(unrolled.pairs, kept, strict=False):
                    L[pair] = entry
                a = kept[-n:]
                held = [solve_factorized(L, kept[pairs:-n], scalars(cotangents[0])), a]
                differentiated = [at.inverse_dynamics(a, inertias)]
        else:
            results = differentiated = _results(at, given, inertias, request.function)

    def nodes(*arrays: Iterable[Any]) -> list[int]:
        return [node_of(graph, scalar) for array in arrays for scalar in array]

    if request.is_value:
        outputs = {name: nodes(result) for name, result in zip(request.outputs, results, strict=True)}
        return Program(graph, inputs, outputs, nodes(positive))
    wanted = {name: nodes(given[name]) for name in request.wanted if name != "tau"}
    after = nodes(-held[0]) if held else nodes(*cotangents)
    found = iter(gradients(graph, nodes(*differentiated), after, [x for v in wanted.values() for x in v], nodes(*held)))
    outputs = {name: [next(found) for _ in vector] for name, vector in wanted.items()}
    if "tau" in request.wanted:
        outputs["tau"] = nodes(held[0])
    return Program(graph, inputs, {name: outputs[name] for name in request.wanted}, sums=("inertias",))


def _merged(unrolled: UnrolledRobot, request: Request, graph: Graph, parameters: list[Expression]) -> Scalars:
    """The entries of the bodies' inertias, by the same code as the robot's own."""
    robot = unrolled.robot

    def entries(given: Tensor) -> list[Tensor]:
        bodies = merged_inertias(robot.tree, robot.layout, dict(zip(request.links, given.unbind(0), strict=True)))
        return [bodies[:, ROWS, COLUMNS]]

    example = torch.zeros(len(request.links), 10, dtype=torch.float64)
    _, (found,) = trace(entries, [example], graph, parameters)
    return expressions(graph, found).ravel()


def _results(
    at: UnrolledKinematics, arguments: dict[str, list[Expression]], inertias: list[Scalars] | None, function: str
) -> list[Scalars]:
    names = ("mass_matrix", "bias_forces") if function == "mass_matrix_and_bias" else (function,)
    a = [scalars(arguments["a"])] if function == "inverse_dynamics" else []
    return [getattr(at, name)(*a, inertias).ravel() for name in names]


PURPOSE = Purpose("compiled dynamics", "robot.compile(folder=...)", "use the robot itself")


def compiled_program(unrolled: UnrolledRobot, request: Request, folder: Path) -> RowFunction:
    """From ``folder`` if it is there, else compiled into it. Raises CompilerError as `load_library`."""

    def write(unit: VectorUnit) -> str:
        return write_program(trace_dynamics(unrolled, request), unit.lanes)

    constants: list[object] = [(joint.parent, joint.axis, joint.kind, *joint.drive) for joint in unrolled.joints]
    constants += [x.tolist() for joint in unrolled.joints for x in (joint.rotation, joint.origin)]
    constants += [unrolled.gravity.tolist(), unrolled.armature.tolist()]
    if request.links:
        tree = unrolled.robot.tree
        constants = [unrolled.robot.layout.moving]
        constants += [x.tolist() for x in (tree.link_inertias, tree.link_offsets, tree.carried)]
    elif not request.free_inertias:
        constants += [body.tolist() for body in unrolled.inertias]
    key = f"{constants!r}\0{request!r}"
    library, _ = load_library(f"{unrolled.robot.name[:40]}-{request.function}", key, write, folder, PURPOSE)
    sizes = request.sizes(unrolled)
    return RowFunction(library, [sizes[name] for name in request.inputs], [sizes[name] for name in request.outputs])
