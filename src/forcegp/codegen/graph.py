"""Straight-line arithmetic on scalars: what every program that is made at run time is written from.

A `Graph` holds each operation once, and none that constants decide. Derivatives (`codegen.derivatives`) are nodes of
the same graph (Griewank & Walther, "Evaluating Derivatives", 2008, ch. 3 and 4).
"""

import math
import operator
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import erf

Slopes = Mapping[tuple[int, int], int]
"""(value, operand) of a call -> the output that is the derivative of the one in the other; 0 where there is none."""

ZERO, ONE = 0, 1
"""Numbers of the nodes that hold these constants."""

CIRCULAR = ("sin", "cos", "tan", "asin", "acos", "atan")
OTHERS = ("sqrt", "sinh", "cosh", "tanh", "asinh", "exp", "log", "log1p", "expm1", "erf")
UNARY: dict[str, Callable[[float], float]] = {
    "negate": operator.neg,
    "absolute": abs,
    **{name: getattr(math, name) for name in (*CIRCULAR, *OTHERS)},
}
ARITHMETIC = {"add": operator.add, "subtract": operator.sub, "multiply": operator.mul, "divide": operator.truediv}
COMPARED = {"less": operator.lt, "at_most": operator.le, "equal": operator.eq}
BINARY: dict[str, Callable[[float, float], float]] = {**ARITHMETIC, "power": math.pow, "atan2": math.atan2, **COMPARED}
COMMUTATIVE = ("add", "multiply", "equal")
LEAVES = ("constant", "input")


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

    def more_inputs(self, count: int) -> "list[Expression]":
        """Scalars that are given when the program runs, after those before."""
        added = [self._record(("input", len(self.inputs) + k)) for k in range(count)]
        self.inputs += added
        return [Expression(self, node) for node in added]

    def constant(self, value: float | int) -> int:
        """The node of a number."""
        return self._record(("constant", float(value) + 0.0))  # -0.0 becomes 0.0

    def value(self, node: int) -> float | None:
        """The number that a node holds whatever the inputs are, or None."""
        operation, *operands = self.nodes[node]
        return operands[0] if operation == "constant" else None

    def call(self, name: str, operands: Sequence[int], outputs: int, slopes: Slopes | None = None) -> list[int]:
        """The outputs of a C function; `slopes` names those beyond them that are derivatives."""
        call = self._record(("call", name, *operands))
        self.outputs_of[call] = max([outputs, *(1 + k for k in (slopes or {}).values())])
        if slopes is not None:
            self.slopes[call] = slopes
        return [self.output(call, k) for k in range(outputs)]

    def call_of(self, other: "Graph", call: int, operands: Sequence[int]) -> int:
        """The same call as in another graph."""
        made = self._record(("call", other.nodes[call][1], *operands))
        self.outputs_of[made] = other.outputs_of[call]
        if call in other.slopes:
            self.slopes[made] = other.slopes[call]
        return made

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
            return self.constant(_folded(operation, known))
        simpler = self._simplified(operation, operands, known)
        if simpler is not None:
            return simpler
        return self._record((operation, *(sorted(operands) if operation in COMMUTATIVE else operands)))

    def sum(self, nodes: Iterable[int]) -> int:
        """The sum of nodes."""
        total = ZERO
        for node in nodes:
            total = self.apply("add", total, node)
        return total

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

    def operations(self, outputs: Iterable[int]) -> int:
        """How many operations these nodes take."""
        return sum(self.nodes[node][0] not in LEAVES for node in self.needed(outputs))

    def _simplified(self, operation: str, operands: tuple[int, ...], known: Sequence[float | None]) -> int | None:
        """A node that is equal whatever the inputs are, or None."""
        x = operands[0]
        if operation == "negate":
            inner = self.nodes[x]
            if inner[0] == "subtract":
                return self._record(("subtract", inner[2], inner[1]))
            return self._negated(x)
        if len(operands) < 2:
            return None
        y = operands[1]
        minus_x, minus_y = self._negated(x), self._negated(y)
        match operation:
            case "add" if ZERO in operands:
                return y if x == ZERO else x
            case "add" if minus_y is not None:
                return self.apply("subtract", x, minus_y)
            case "add" if minus_x is not None:
                return self.apply("subtract", y, minus_x)
            case "subtract" if x == y:
                return ZERO
            case "subtract" if ZERO in operands:
                return x if y == ZERO else self.apply("negate", y)
            case "subtract" if minus_y is not None:
                return self.apply("add", x, minus_y)
            case "multiply" if ZERO in operands:
                return ZERO
            case "multiply" if ONE in operands:
                return y if x == ONE else x
            case "multiply" | "divide" if minus_x is not None:
                return self.apply("negate", self.apply(operation, minus_x, y))
            case "multiply" | "divide" if minus_y is not None:
                return self.apply("negate", self.apply(operation, x, minus_y))
            case "divide" if x == ZERO or y == ONE:
                return x
            case "divide" if known[1]:
                return self.apply("multiply", x, self.constant(1.0 / known[1]))
        return None

    def _negated(self, node: int) -> int | None:
        """x where the node is -x or a negative number."""
        operation, *operands = self.nodes[node]
        if operation == "constant" and operands[0] < 0.0:
            return self.constant(-operands[0])
        return operands[0] if operation == "negate" else None

    def _record(self, entry: tuple) -> int:
        found = self._found.get(entry)
        if found is None:
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
                known[node] = graph.call_of(self.other, node, [known[operand] for operand in rest[1:]])
            elif operation == "output":
                known[node] = graph.output(known[rest[0]], rest[1])
            else:
                known[node] = graph.apply(operation, *(known[operand] for operand in rest))
        return [known[node] for node in nodes]


def _operator(operation: str, swapped: bool = False) -> "Callable[..., Expression | float]":
    def recorded(self: "Expression", *others: "Expression | float") -> "Expression | float":
        operands = (*others, self) if swapped else (self, *others)
        node = self.graph.apply(operation, *(node_of(self.graph, x) for x in operands))
        value = self.graph.value(node)
        return Expression(self.graph, node) if value is None else value

    return recorded


class Expression:
    """A scalar that stands for a node of a `Graph`; what turns out to be known is a float."""

    __slots__ = ("graph", "node")

    def __init__(self, graph: Graph, node: int) -> None:
        self.graph, self.node = graph, node

    __add__ = __radd__ = _operator("add")
    __sub__, __rsub__ = _operator("subtract"), _operator("subtract", swapped=True)
    __mul__ = __rmul__ = _operator("multiply")
    __truediv__, __rtruediv__ = _operator("divide"), _operator("divide", swapped=True)
    __neg__, exp, sin, cos = map(_operator, ("negate", "exp", "sin", "cos"))


def node_of(graph: Graph, scalar: Expression | float) -> int:
    """The node of a scalar; floats become constants."""
    return scalar.node if isinstance(scalar, Expression) else graph.constant(scalar)


def _folded(operation: str, operands: Sequence[float | None]) -> float:
    """An operation on known numbers; outside its domain NaN, as a processor has it."""
    try:
        return float({**UNARY, **BINARY}[operation](*operands))  # type: ignore[arg-type]  # the caller has checked that none is None
    except (ValueError, ZeroDivisionError, OverflowError):
        return math.nan


FUNCTIONS: dict[str, Any] = {
    **{name: getattr(np, name) for name in ("absolute", "sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp")},
    **{name: getattr(np, name) for name in ("log", "log1p", "expm1", "add", "subtract", "multiply", "divide", "power")},
    **{name: getattr(np, f"arc{name[1:]}") for name in ("asin", "acos", "atan", "asinh", "atan2")},
    **{name: lambda x, y, compared=compared: np.where(compared(x, y), 1.0, 0.0) for name, compared in COMPARED.items()},
    "negate": np.negative,
    "erf": erf,
    "choose": lambda m, x, y: np.where(m != 0.0, x, y),
}


def evaluated(graph: Graph, outputs: Sequence[int], inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The nodes `outputs` of a graph without calls, from one array per input."""
    found: dict[int, Any] = {}
    with np.errstate(all="ignore"):
        for node in graph.needed(outputs):
            operation, *rest = graph.nodes[node]
            match operation:
                case "constant":
                    found[node] = rest[0]
                case "input":
                    found[node] = inputs[rest[0]]
                case "look up":
                    found[node] = np.asarray(rest[0])[np.asarray(found[rest[1]]).astype(int)]
                case _:
                    found[node] = FUNCTIONS[operation](*(found[operand] for operand in rest))
    return [np.asarray(found[node], dtype=np.float64) for node in outputs]
