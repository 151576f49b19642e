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

from forcegp.robots.expressions import Expression, Graph, gradients
from forcegp.robots.scalar_algebra import Matrix, Scalar, Vector, factorize, minus, negate, solve_factorized
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

# The ten different entries of a symmetric 4x4 pseudo-inertia, in the order in which programs take them.
INERTIA_ENTRIES = tuple((row, column) for row in range(4) for column in range(row, 4))


@dataclass(frozen=True)
class Request:
    """Which program: a function of the robot, with the inertias as inputs or as constants, its value or derivatives.

    ``states`` and ``inertias`` choose the derivatives: those in all arguments, those in the inertias, both; the value
    if neither.
    """

    function: str
    free_inertias: bool
    states: bool = False
    inertias: bool = False

    @property
    def arguments(self) -> tuple[str, ...]:
        """Arguments of the function in the order in which the program takes them."""
        return ARGUMENTS[self.function] + (("inertias",) if self.free_inertias else ())

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
        states = ARGUMENTS[self.function] if self.states else ()
        return states + (("inertias",) if self.inertias else ())

    @property
    def is_value(self) -> bool:
        """Whether the program computes the function itself."""
        return not (self.states or self.inertias)


@dataclass(frozen=True)
class DynamicsProgram:
    """Straight-line arithmetic: ``outputs`` by name; all ``positive`` must be > 0."""

    graph: Graph
    outputs: dict[str, Vector]
    positive: Vector

    @property
    def needed(self) -> list[int]:
        """Nodes of the graph that this program computes, operands first."""
        return self.graph.needed([scalar for vector in self.outputs.values() for scalar in vector] + self.positive)

    @property
    def operations(self) -> int:
        """Number of arithmetic operations."""
        nodes = self.graph.nodes
        return sum(nodes[index].operation in ("+", "-", "*", "/", "negate", "sqrt") for index in self.needed)


def trace_dynamics(unrolled: UnrolledRobot, request: Request) -> DynamicsProgram:
    """Write a program down."""
    graph, n = Graph(), unrolled.nv
    arguments = {name: graph.inputs(name, n) for name in ARGUMENTS[request.function]}
    inertias = None
    if request.free_inertias:
        arguments["inertias"] = graph.inputs("inertias", len(INERTIA_ENTRIES) * n)
        inertias = [_symmetric(arguments["inertias"][10 * body : 10 * body + 10]) for body in range(n)]
    at = UnrolledKinematics(unrolled, arguments["q"], arguments.get("v"))
    positive: Vector = []
    if request.function == "forward_dynamics":
        results, held, differentiated = _forward_dynamics(at, arguments["tau"], inertias, graph, request, positive)
    else:
        results = _results(at, arguments, inertias, request.function)
        held, differentiated = [], results
    if request.is_value:
        return DynamicsProgram(graph, dict(zip(request.results, results, strict=True)), positive)
    if request.function == "forward_dynamics":
        cotangents = [[negate(x) for x in held[0]]]
    else:
        cotangents = [graph.inputs(name, len(result)) for name, result in zip(request.results, results, strict=True)]
    wanted = [expression for name in request.wanted if name != "tau" for expression in arguments[name]]
    flat = [
        (scalar, cotangent)
        for result, vector in zip(differentiated, cotangents, strict=True)
        for scalar, cotangent in zip(result, vector, strict=True)
    ]
    found = iter(gradients(graph, [s for s, _ in flat], [c for _, c in flat], wanted, [x for v in held for x in v]))
    outputs = {name: [next(found) for _ in arguments[name]] for name in request.wanted if name != "tau"}
    if "tau" in request.wanted:
        outputs["tau"] = held[0]
    return DynamicsProgram(graph, {name: outputs[name] for name in request.wanted}, [])


def _forward_dynamics(
    at: UnrolledKinematics,
    tau: list[Expression],
    inertias: list[Matrix] | None,
    graph: Graph,
    request: Request,
    positive: Vector,
) -> tuple[list[Vector], list[Vector], list[Vector]]:
    """The accelerations; for derivatives [l, a], and inverse dynamics at a."""
    factor, pivots = factorize(at.mass_matrix(inertias))
    a = solve_factorized(factor, pivots, minus(tau, at.bias_forces(inertias)))
    positive.extend(pivots)
    if request.is_value:
        return [a], [], []
    (name,) = request.results
    adjoint = solve_factorized(factor, pivots, graph.inputs(name, len(a)))
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
