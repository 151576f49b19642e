"""Straight-line arithmetic on scalars, each operation once: what all programs that are made at run time consist of.

Derivatives are nodes of the same graph (Griewank & Walther, "Evaluating Derivatives", 2008).
"""

import math
import operator
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np

from forcegp.errors import InvalidInput

Slopes = Mapping[tuple[int, int], int]
"""(value, operand) of a call -> the output that is the derivative of the one in the other; 0 where there is none."""

ZERO, ONE = 0, 1  # numbers of the nodes that hold these constants

NAMED = ("sin", "cos", "tan", "sqrt", "tanh", "asinh", "exp", "log", "log1p", "expm1")
UNARY: dict[str, Any] = {"negate": operator.neg, "absolute": abs, **{name: getattr(math, name) for name in NAMED}}
ARITHMETIC = {"add": operator.add, "subtract": operator.sub, "multiply": operator.mul, "divide": operator.truediv}
COMPARED = {"less": operator.lt, "at_most": operator.le, "equal": operator.eq}
BINARY: dict[str, Callable[[float, float], float]] = {**ARITHMETIC, "power": math.pow, "atan2": math.atan2, **COMPARED}
COMMUTATIVE = ("add", "multiply", "equal")
LEAVES = ("constant", "input")
FLAT = ("less", "at_most", "equal", "look up", "input", "constant", "call")
"""Without derivatives; a call is used through its outputs."""


class Graph:
    """All operations recorded so far: tuples of an operation and its operands, which have smaller numbers.

    Beside `UNARY` and `BINARY`: "choose" (m != 0 ? x : y), "input" (position), "constant" (value), "look up" (table,
    place), "call" (name of a C function, operands), "output" (call, position).
    """

    def __init__(self, inputs: int = 0) -> None:
        self.nodes: list[tuple] = []
        self.slopes: dict[int, Slopes] = {}
        self.outputs_of: dict[int, int] = {}  # how many numbers a call gives
        self._found: dict[tuple, int] = {}
        self._record(("constant", 0.0))
        self._record(("constant", 1.0))
        self.inputs = [self._record(("input", position)) for position in range(inputs)]

    def more_inputs(self, count: int) -> None:
        """Scalars that are given when the program runs, after those before."""
        self.inputs += [self._record(("input", len(self.inputs) + k)) for k in range(count)]

    def constant(self, value: float | int) -> int:
        """The node of a number."""
        return self._record(("constant", float(value) + 0.0))  # -0.0 becomes 0.0

    def value(self, node: int) -> float | None:
        """The number that a node holds whatever the inputs are, or None."""
        operation, *operands = self.nodes[node]
        return operands[0] if operation == "constant" else None

    def call(self, name: str, operands: Sequence[int], outputs: int, slopes: Slopes | None = None) -> list[int]:
        """The outputs of a C function; `slopes` names those beyond them that are derivatives."""
        call = self.called(name, operands, max([outputs, *(1 + k for k in (slopes or {}).values())]), slopes)
        return [self.output(call, k) for k in range(outputs)]

    def called(self, name: str, operands: Sequence[int], outputs: int, slopes: Slopes | None) -> int:
        """The node of a call, which gives so many numbers."""
        call = self._record(("call", name, *operands))
        self.outputs_of[call] = outputs
        if slopes is not None:
            self.slopes[call] = slopes
        return call

    def output(self, call: int, position: int) -> int:
        """One output of a call."""
        return self._record(("output", call, position))

    def look_up(self, table: Sequence[float], place: int) -> int:
        """The entry of a table of numbers at the place that a node holds."""
        known = self.value(place)
        return self._record(("look up", tuple(table), place)) if known is None else self.constant(table[int(known)])

    def apply(self, operation: str, *operands: int) -> int:
        """The node of an operation on nodes."""
        known = [self.value(operand) for operand in operands]
        if operation == "choose":
            if known[0] is not None:
                return operands[1] if known[0] else operands[2]
            return operands[1] if operands[1] == operands[2] else self._record((operation, *operands))
        if None not in known:
            try:
                return self.constant(float({**UNARY, **BINARY}[operation](*known)))  # type: ignore[arg-type]  # none is None
            except (ValueError, ZeroDivisionError, OverflowError):  # outside its domain NaN, as a processor has it
                return self.constant(math.nan)
        if (simpler := self._simplified(operation, operands, known)) is not None:
            return simpler
        return self._record((operation, *(sorted(operands) if operation in COMMUTATIVE else operands)))

    def sum(self, nodes: Iterable[int]) -> int:
        """The sum of nodes."""
        return reduce(partial(self.apply, "add"), nodes, ZERO)

    def dot(self, left: Iterable[int], right: Iterable[int]) -> int:
        """sum_k left_k right_k."""
        return self.sum(self.apply("multiply", x, y) for x, y in zip(left, right, strict=True))

    def operands(self, node: int) -> tuple[int, ...]:
        """The nodes that a node is computed from."""
        operation, *rest = self.nodes[node]
        if operation in LEAVES:
            return ()
        if operation in ("call", "look up"):
            return tuple(rest[1:])
        return (rest[0],) if operation == "output" else tuple(rest)

    def needed(self, outputs: Iterable[int], given: Container[int] = ()) -> list[int]:
        """The nodes that `outputs` depend on, operands first; not through those `given`."""
        wanted = set(outputs)
        for node in range(max(wanted, default=-1), -1, -1):
            if node in wanted and node not in given:
                wanted.update(self.operands(node))
        return sorted(wanted)

    def _simplified(self, operation: str, operands: tuple[int, ...], known: Sequence[float | None]) -> int | None:
        x = operands[0]
        if operation == "negate":
            inner = self.nodes[x]
            if inner[0] == "subtract":
                return self._record(("subtract", inner[2], inner[1]))
            return inner[1] if inner[0] == "negate" else None
        if len(operands) < 2:
            return None
        y = operands[1]
        match operation:
            case "add" if ZERO in operands:
                return y if x == ZERO else x
            case "subtract" if x == y:
                return ZERO
            case "subtract" if ZERO in operands:
                return x if y == ZERO else self.apply("negate", y)
            case "multiply" if ZERO in operands:
                return ZERO
            case "multiply" if ONE in operands:
                return y if x == ONE else x
            case "divide" if x == ZERO or y == ONE:
                return x
            case "divide" if known[1]:
                return self.apply("multiply", x, self.constant(1.0 / known[1]))
        return None

    def _record(self, entry: tuple) -> int:
        if (found := self._found.get(entry)) is None:
            found = self._found[entry] = len(self.nodes)
            self.nodes.append(entry)
        return found


class Copier:
    """Copies nodes of one graph to another; `known` are those that are there, such as the inputs."""

    def __init__(self, graph: Graph, other: Graph, known: dict[int, int]) -> None:
        self.graph, self.other, self.known = graph, other, known

    def __call__(self, nodes: Sequence[int]) -> list[int]:
        """The nodes there."""
        graph, known = self.graph, self.known
        for node in self.other.needed(nodes, known):
            if node in known:
                continue
            operation, *rest = self.other.nodes[node]
            if operation == "constant":
                known[node] = graph.constant(rest[0])
            elif operation == "look up":
                known[node] = graph.look_up(rest[0], known[rest[1]])
            elif operation == "call":
                operands, outputs = [known[operand] for operand in rest[1:]], self.other.outputs_of[node]
                known[node] = graph.called(rest[0], operands, outputs, self.other.slopes.get(node))
            elif operation == "output":
                known[node] = graph.output(known[rest[0]], rest[1])
            else:
                known[node] = graph.apply(operation, *(known[operand] for operand in rest))
        return [known[node] for node in nodes]


FUNCTIONS: dict[str, Any] = {
    **{name: getattr(np, name) for name in ("absolute", "sqrt", "sin", "cos", "tan", "tanh", "exp")},
    **{name: getattr(np, name) for name in ("log", "log1p", "expm1", "add", "subtract", "multiply", "divide", "power")},
    **{name: getattr(np, f"arc{name[1:]}") for name in ("asinh", "atan2")},
    **{name: lambda x, y, compared=compared: np.where(compared(x, y), 1.0, 0.0) for name, compared in COMPARED.items()},
    "negate": np.negative,
    "choose": lambda m, x, y: np.where(m != 0.0, x, y),
    "look up": lambda table, place: np.asarray(table)[np.asarray(place).astype(int)],
}


def interpreted(
    graph: Graph, outputs: Sequence[int], inputs: Sequence[Any], functions: Mapping[str, Any], known: Any = None
) -> list[Any]:
    """The nodes `outputs` of a graph without calls, where `functions` compute; `known` are nodes that are there."""
    found = dict(known or {})
    for node in graph.needed(outputs, found):
        operation, *rest = graph.nodes[node]
        if node in found:
            continue
        if operation in LEAVES:
            found[node] = rest[0] if operation == "constant" else inputs[rest[0]]
        else:
            table = rest[:1] if operation == "look up" else []
            found[node] = functions[operation](*table, *(found[x] for x in graph.operands(node)))
    return [found[node] for node in outputs]


def jacobian(
    graph: Graph, outputs: Sequence[int], inputs: Sequence[int], seeds: Sequence[Sequence[int]] | None = None
) -> list[list[int]]:
    """d outputs_i / d inputs_j, (outputs, inputs); with `seeds` (inputs, directions) that matrix times this one."""
    if seeds is None:
        seeds = [[ONE if i == j else ZERO for j in range(len(inputs))] for i in range(len(inputs))]
    directions, given = range(len(seeds[0]) if seeds else 0), zip(inputs, seeds, strict=True)
    tangents = {node: {j: row[j] for j in directions if row[j] != ZERO} for node, row in given}
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
    operation, operands = graph.nodes[node][0], graph.operands(node)
    if operation in FLAT:
        return []
    if operation == "output":
        _, call, position = graph.nodes[node]
        if (found := graph.slopes.get(call)) is None:
            raise InvalidInput(f"{graph.nodes[call][1]} gives no derivatives; make the program with slopes.")
        each = ((operand, found.get((position, k))) for k, operand in enumerate(graph.operands(call)))
        return [(operand, partial(graph.output, call, slope)) for operand, slope in each if slope is not None]
    apply, constant, x = graph.apply, graph.constant, operands[0]

    def square(y: int) -> int:
        return apply("multiply", y, y)

    slopes: dict[str, Callable[[], int]] = {
        "negate": lambda: constant(-1.0),
        "absolute": lambda: apply("subtract", apply("less", ZERO, x), apply("less", x, ZERO)),  # none at 0, as in torch
        "sqrt": lambda: apply("divide", constant(0.5), node),
        "sin": lambda: apply("cos", x),
        "cos": lambda: apply("negate", apply("sin", x)),
        "tan": lambda: apply("add", ONE, square(node)),
        "tanh": lambda: apply("subtract", ONE, square(node)),
        "asinh": lambda: apply("divide", ONE, apply("sqrt", apply("add", ONE, square(x)))),
        "exp": lambda: node,
        "log": lambda: apply("divide", ONE, x),
        "log1p": lambda: apply("divide", ONE, apply("add", ONE, x)),
        "expm1": lambda: apply("add", ONE, node),
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
    raise AssertionError(operation)
