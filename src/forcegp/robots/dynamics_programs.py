"""The dynamics of one robot, and their derivatives, as programs: straight-line arithmetic from inputs to outputs.

Derivatives of forward dynamics ``a = M^-1 (tau - bias)`` do not go through the factorisation. With ``l = M^-1 g`` for
the cotangent g of a,

    d <g, a> = <l, dtau> - d <l, ID(q, v, a)>  with l and a held,

so that beyond the accelerations themselves they cost one more solution with the same factor and the derivative of
inverse dynamics ID (implicit differentiation; Carpentier & Mansard, "Analytical derivatives of rigid body dynamics
algorithms", RSS 2018).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.codegen.c_writer import Program
from forcegp.codegen.derivatives import gradients
from forcegp.codegen.graph import Expression, Graph, node_of
from forcegp.codegen.tracing import trace
from forcegp.robots.scalar_algebra import Matrix, Scalar, Vector, factorize, minus, negate, solve_factorized
from forcegp.robots.tree import merged_inertias
from forcegp.robots.unrolled import UnrolledRobot
from forcegp.robots.unrolled_kinematics import UnrolledKinematics

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

MERGED = "merged_inertias"
"""The function from log-Cholesky parameters of links to the inertias of bodies, which the others take."""

# The ten different entries of a symmetric 4x4 pseudo-inertia, in the order in which programs take them.
INERTIA_ENTRIES = tuple((row, column) for row in range(4) for column in range(row, 4))
ROWS, COLUMNS = (list(entries) for entries in zip(*INERTIA_ENTRIES, strict=True))


@dataclass(frozen=True)
class Request:
    """Which program: a function of the robot, with the inertias as inputs or as constants, its value or derivatives.

    ``states`` and ``inertias`` choose the derivatives: those in all arguments, those in the inertias, both; the value
    if neither. ``links`` are those whose parameters `MERGED` takes.
    """

    function: str
    free_inertias: bool = False
    states: bool = False
    inertias: bool = False
    links: tuple[str, ...] = ()

    @property
    def arguments(self) -> tuple[str, ...]:
        """Arguments of the function in the order in which the program takes them."""
        return self._states + (("inertias",) if self.free_inertias else ())

    @property
    def _states(self) -> tuple[str, ...]:
        return ("parameters",) if self.function == MERGED else ARGUMENTS[self.function]

    @property
    def inputs(self) -> tuple[str, ...]:
        """What the program takes, in order: the arguments and, for derivatives, the cotangents of the results."""
        return self.arguments + (() if self.is_value else self.results)

    @property
    def results(self) -> tuple[str, ...]:
        """Names of the results of the function, and of their cotangents."""
        return tuple(f"result {k}" for k in range(len(DIMENSIONS.get(self.function, (1,)))))

    @property
    def wanted(self) -> tuple[str, ...]:
        """Arguments of which this is the derivative, in order."""
        states = self._states if self.states else ()
        return states + (("inertias",) if self.inertias else ())

    @property
    def is_value(self) -> bool:
        """Whether the program computes the function itself."""
        return not (self.states or self.inertias)

    def sizes(self, nv: int) -> dict[str, int]:
        """Length of every input, result and derivative by name."""
        results = {MERGED: (len(INERTIA_ENTRIES) * nv,)}.get(
            self.function, tuple(nv**d for d in DIMENSIONS.get(self.function, (1,)))
        )
        given = {"inertias": len(INERTIA_ENTRIES) * nv, "parameters": 10 * len(self.links)}
        return {name: given.get(name, nv) for name in self.arguments} | dict(zip(self.results, results, strict=True))


def trace_dynamics(unrolled: UnrolledRobot, request: Request) -> Program:
    """Write a program down."""
    n, sizes = unrolled.nv, request.sizes(unrolled.nv)
    inputs = {name: sizes[name] for name in request.inputs}
    graph = Graph()
    given = {name: graph.more_inputs(size) for name, size in inputs.items() if name in request.arguments}
    cotangents = [graph.more_inputs(inputs[name]) for name in request.results if not request.is_value]
    positive: list[Scalar] = []
    held: list[Vector] = []
    if request.function == MERGED:
        results = differentiated = [_merged(unrolled, request, graph, given["parameters"])]
    else:
        inertias = None
        if request.free_inertias:
            inertias = [_symmetric(given["inertias"][10 * body : 10 * body + 10]) for body in range(n)]
        at = UnrolledKinematics(unrolled, given["q"], given.get("v"))
        if request.function == "forward_dynamics":
            results, held, differentiated = _forward_dynamics(at, given["tau"], inertias, positive, cotangents)
        else:
            results = differentiated = _results(at, given, inertias, request.function)

    def nodes(scalars: list[Scalar]) -> list[int]:
        return [node_of(graph, scalar) for scalar in scalars]

    if request.is_value:
        outputs = {name: nodes(result) for name, result in zip(request.results, results, strict=True)}
        return Program(graph, inputs, outputs, nodes(positive))
    if held:
        cotangents = [[negate(x) for x in held[0]]]
    wanted = {name: nodes(given[name]) for name in request.wanted if name != "tau"}
    found = iter(
        gradients(
            graph,
            nodes([scalar for vector in differentiated for scalar in vector]),
            nodes([scalar for vector in cotangents for scalar in vector]),
            [node for vector in wanted.values() for node in vector],
            nodes([scalar for vector in held for scalar in vector]),
        )
    )
    outputs = {name: [next(found) for _ in vector] for name, vector in wanted.items()}
    if "tau" in request.wanted:
        outputs["tau"] = nodes(held[0])
    return Program(graph, inputs, {name: outputs[name] for name in request.wanted}, sums=("inertias",))


def _merged(unrolled: UnrolledRobot, request: Request, graph: Graph, parameters: list[Expression]) -> list[Scalar]:
    """The entries of the bodies' inertias, by the same code as the robot's own."""
    robot = unrolled.robot

    def entries(given: Tensor) -> list[Tensor]:
        bodies = merged_inertias(robot.tree, robot.layout, dict(zip(request.links, given.unbind(0), strict=True)))
        return [bodies[:, ROWS, COLUMNS]]

    example = torch.zeros(len(request.links), 10, dtype=torch.float64)
    _, (found,) = trace(entries, [example], graph, parameters)
    return [Expression(graph, node) for node in found.flatten().tolist()]


def _forward_dynamics(
    at: UnrolledKinematics,
    tau: list[Expression],
    inertias: list[Matrix] | None,
    positive: Vector,
    cotangents: list[list[Expression]],
) -> tuple[list[Vector], list[Vector], list[Vector]]:
    """The accelerations; for derivatives [l, a], and inverse dynamics at a."""
    factor, pivots = factorize(at.mass_matrix(inertias))
    a = solve_factorized(factor, pivots, minus(tau, at.bias_forces(inertias)))
    positive.extend(pivots)
    if not cotangents:
        return [a], [], []
    adjoint = solve_factorized(factor, pivots, cotangents[0])
    return [a], [adjoint, a], [at.inverse_dynamics(a, inertias)]


def _results(
    at: UnrolledKinematics, arguments: dict[str, list[Expression]], inertias: list[Matrix] | None, function: str
) -> list[Vector]:
    match function:
        case "mass_matrix":
            return [_flat(at.mass_matrix(inertias))]
        case "bias_forces":
            return [at.bias_forces(inertias)]
        case "mass_matrix_and_bias":
            return [_flat(at.mass_matrix(inertias)), at.bias_forces(inertias)]
        case "gravity_forces":
            return [at.gravity_forces(inertias)]
        case _:
            return [at.inverse_dynamics(arguments["a"], inertias)]


def _flat(matrix: Matrix) -> Vector:
    return [scalar for row in matrix for scalar in row]


def _symmetric(entries: list[Expression]) -> Matrix:
    P: list[list[Scalar]] = [[0.0] * 4 for _ in range(4)]
    for (row, column), entry in zip(INERTIA_ENTRIES, entries, strict=True):
        P[row][column] = P[column][row] = entry
    return P
