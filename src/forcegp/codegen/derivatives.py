"""Derivatives of straight-line arithmetic, as nodes of the same graph: backwards for few outputs, else forwards."""

import math
from collections.abc import Callable, Sequence
from functools import partial

from forcegp.codegen.graph import ONE, ZERO, Graph
from forcegp.errors import InvalidInput

FLAT = ("less", "at_most", "equal", "look up", "input", "constant", "call")
"""Without derivatives; a call is used through its outputs."""


def gradients(
    graph: Graph, outputs: Sequence[int], cotangents: Sequence[int], wanted: Sequence[int], held: Sequence[int] = ()
) -> list[int]:
    """``sum_k cotangents_k d outputs_k / d wanted``; ``held`` and the cotangents count as constants."""
    adjoint: dict[int, int] = {}
    for output, cotangent in zip(outputs, cotangents, strict=True):
        adjoint[output] = graph.apply("add", adjoint.get(output, ZERO), cotangent)
    targets, stops = set(wanted), {node for node in held if graph.value(node) is None}
    depends: set[int] = set()
    for node in range(max(outputs, default=-1) + 1):
        if node not in stops and (node in targets or not depends.isdisjoint(graph.operands(node))):
            depends.add(node)
    for node in range(max(outputs, default=-1), -1, -1):
        above = adjoint.get(node, ZERO)
        if node not in depends or above == ZERO or node in targets:
            continue
        for operand, slope in partials(graph, node):
            if operand in depends:
                share = graph.apply("multiply", above, slope())
                adjoint[operand] = graph.apply("add", adjoint.get(operand, ZERO), share)
    return [adjoint.get(node, ZERO) for node in wanted]


def jacobian(
    graph: Graph, outputs: Sequence[int], inputs: Sequence[int], seeds: Sequence[Sequence[int]] | None = None
) -> list[list[int]]:
    """d outputs_i / d inputs_j, (outputs, inputs); with `seeds` (inputs, directions) that matrix times this one."""
    if seeds is None:
        seeds = [[ONE if i == j else ZERO for j in range(len(inputs))] for i in range(len(inputs))]
    directions = range(len(seeds[0]) if seeds else 0)
    tangents: dict[int, dict[int, int]] = {
        node: {j: row[j] for j in directions if row[j] != ZERO} for node, row in zip(inputs, seeds, strict=True)
    }
    for node in graph.needed(outputs):
        if node in tangents:
            continue
        found: dict[int, int] = {}
        if graph.nodes[node][0] == "choose":  # not by products: what is not chosen may be infinite
            m, x, y = graph.operands(node)
            left, right = tangents.get(x, {}), tangents.get(y, {})
            for j in {**left, **right}:
                found[j] = graph.apply("choose", m, left.get(j, ZERO), right.get(j, ZERO))
        else:
            for operand, slope in partials(graph, node):
                given = tangents.get(operand)
                factor = slope() if given else ZERO
                for j, tangent in (given or {}).items():
                    product = graph.apply("multiply", factor, tangent)
                    found[j] = graph.apply("add", found[j], product) if j in found else product
        if found:
            tangents[node] = found
    return [[tangents.get(output, {}).get(j, ZERO) for j in directions] for output in outputs]


def partials(graph: Graph, node: int) -> list[tuple[int, Callable[[], int]]]:
    """The operands of a node, and what makes its derivative in each of them when it is needed."""
    operation = graph.nodes[node][0]
    operands = graph.operands(node)
    if operation in FLAT:
        return []
    if operation == "output":
        return _slopes_of_call(graph, node)
    apply, constant, x = graph.apply, graph.constant, operands[0]

    def inverse_root(sign: float, inner: int) -> int:
        """sign / sqrt(1 + inner)."""
        return apply("divide", constant(sign), apply("sqrt", apply("add", ONE, inner)))

    def square(y: int) -> int:
        return apply("multiply", y, y)

    slopes: dict[str, Callable[[], int]] = {
        "negate": lambda: constant(-1.0),
        "absolute": lambda: apply("subtract", apply("less", ZERO, x), apply("less", x, ZERO)),  # none at 0, as in torch
        "sqrt": lambda: apply("divide", constant(0.5), node),
        "sin": lambda: apply("cos", x),
        "cos": lambda: apply("negate", apply("sin", x)),
        "tan": lambda: apply("add", ONE, square(node)),
        "asin": lambda: inverse_root(1.0, apply("negate", square(x))),
        "acos": lambda: inverse_root(-1.0, apply("negate", square(x))),
        "atan": lambda: apply("divide", ONE, apply("add", ONE, square(x))),
        "sinh": lambda: apply("cosh", x),
        "cosh": lambda: apply("sinh", x),
        "tanh": lambda: apply("subtract", ONE, square(node)),
        "asinh": lambda: inverse_root(1.0, square(x)),
        "exp": lambda: node,
        "log": lambda: apply("divide", ONE, x),
        "log1p": lambda: apply("divide", ONE, apply("add", ONE, x)),
        "expm1": lambda: apply("add", ONE, node),
        "erf": lambda: apply("multiply", constant(2.0 / math.sqrt(math.pi)), apply("exp", apply("negate", square(x)))),
    }
    if operation in slopes:
        return [(x, slopes[operation])]
    y = operands[1]
    match operation:
        case "add":
            return [(x, lambda: ONE), (y, lambda: ONE)]
        case "subtract":
            return [(x, lambda: ONE), (y, lambda: constant(-1.0))]
        case "multiply":
            return [(x, lambda: y), (y, lambda: x)]
        case "divide":
            return [(x, lambda: apply("divide", ONE, y)), (y, lambda: apply("negate", apply("divide", node, y)))]
        case "atan2":
            size = apply("add", square(x), square(y))
            return [(x, lambda: apply("divide", y, size)), (y, lambda: apply("negate", apply("divide", x, size)))]
        case "power":
            lower = apply("power", x, apply("subtract", y, ONE))
            log = apply("choose", apply("equal", x, ZERO), ZERO, apply("log", x))
            return [(x, lambda: apply("multiply", y, lower)), (y, lambda: apply("multiply", node, log))]
        case "choose":
            _, y, z = operands
            return [(y, lambda: apply("choose", x, ONE, ZERO)), (z, lambda: apply("choose", x, ZERO, ONE))]
    raise AssertionError(operation)


def _slopes_of_call(graph: Graph, node: int) -> list[tuple[int, Callable[[], int]]]:
    _, call, position = graph.nodes[node]
    found = graph.slopes.get(call)
    if found is None:
        raise InvalidInput(f"{graph.nodes[call][1]} gives no derivatives; make the program with slopes.")
    return [
        (operand, partial(graph.output, call, found[position, k]))
        for k, operand in enumerate(graph.operands(call))
        if (position, k) in found
    ]
