"""Scalars that record what is computed with them, to differentiate it and to write code from it.

A :class:`Graph` holds every operation once: equal operations on equal operands are one node, so common subexpressions
are shared wherever they come from. Derivatives are nodes of the same graph (:func:`gradients`, reverse accumulation:
Griewank & Walther, "Evaluating Derivatives", 2008, ch. 3), so they share what the values compute.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from forcegp.robots.scalar_algebra import Scalar, add, is_zero, multiply, negate

COMMUTATIVE = ("+", "*")


@dataclass(frozen=True)
class Node:
    """One operation: ``input`` (of ``name`` and position), ``constant``, ``+ - * / negate sqrt sin cos``."""

    operation: str
    operands: tuple[int, ...] = ()
    value: float = 0.0
    name: str = ""
    position: int = 0


class Graph:
    """All operations recorded so far; the operands of a node stand before it."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._found: dict[Node, int] = {}

    def inputs(self, name: str, size: int) -> list[Expression]:
        """The entries of a vector that is given when the code runs."""
        return [self._record(Node("input", name=name, position=k)) for k in range(size)]

    def index(self, scalar: Scalar) -> int:
        """Position of the node of a scalar; floats become constants."""
        return scalar.index if isinstance(scalar, Expression) else self._record(Node("constant", value=scalar)).index

    def apply(self, operation: str, *operands: Scalar) -> Expression:
        """The node of an operation."""
        indices = [self.index(operand) for operand in operands]
        return self._record(Node(operation, tuple(sorted(indices) if operation in COMMUTATIVE else indices)))

    def needed(self, outputs: Iterable[Scalar]) -> list[int]:
        """Positions of the nodes that ``outputs`` depend on, in an order in which they can be computed."""
        wanted = {self.index(output) for output in outputs}
        for index in range(max(wanted, default=-1), -1, -1):
            if index in wanted:
                wanted.update(self.nodes[index].operands)
        return sorted(wanted)

    def _record(self, node: Node) -> Expression:
        found = self._found.get(node)
        if found is None:
            found = self._found[node] = len(self.nodes)
            self.nodes.append(node)
        return Expression(self, found)


class Expression:
    """A scalar that stands for a node of a :class:`Graph`."""

    __slots__ = ("graph", "index")

    def __init__(self, graph: Graph, index: int) -> None:
        self.graph, self.index = graph, index

    def _negated(self) -> Expression | None:
        """x where this is ``-x``."""
        node = self.graph.nodes[self.index]
        return Expression(self.graph, node.operands[0]) if node.operation == "negate" else None

    def __add__(self, other: Scalar) -> Expression:
        if isinstance(other, Expression) and (positive := other._negated()) is not None:
            return self.graph.apply("-", self, positive)
        if (positive := self._negated()) is not None:
            return self.graph.apply("-", other, positive)
        return self.graph.apply("+", self, other)

    __radd__ = __add__

    def __sub__(self, other: Scalar) -> Expression:
        if isinstance(other, Expression) and (positive := other._negated()) is not None:
            return self + positive
        return self.graph.apply("-", self, other)

    def __rsub__(self, other: float) -> Expression:
        if (positive := self._negated()) is not None:
            return positive + other
        return self.graph.apply("-", other, self)

    def __mul__(self, other: Scalar) -> Expression:
        if (positive := self._negated()) is not None:
            return -(positive * other)
        if isinstance(other, float) and other < 0.0:
            return -self.graph.apply("*", self, -other)
        if isinstance(other, Expression) and (positive := other._negated()) is not None:
            return -(self * positive)
        return self.graph.apply("*", self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Expression) -> Expression:
        return self.graph.apply("/", self, other)

    def __rtruediv__(self, other: float) -> Expression:
        return self.graph.apply("/", other, self)

    def __neg__(self) -> Expression:
        positive = self._negated()
        return self.graph.apply("negate", self) if positive is None else positive

    def sqrt(self) -> Expression:
        """Square root."""
        return self.graph.apply("sqrt", self)

    def sin(self) -> Expression:
        """Sine."""
        return self.graph.apply("sin", self)

    def cos(self) -> Expression:
        """Cosine."""
        return self.graph.apply("cos", self)


def gradients(
    graph: Graph,
    outputs: Sequence[Scalar],
    cotangents: Sequence[Scalar],
    wanted: Sequence[Expression],
    held: Sequence[Scalar] = (),
) -> list[Scalar]:
    """``sum_k cotangents_k d outputs_k / d wanted``; structural zeros are 0.0.

    ``held`` are taken as constants: nothing is differentiated through them. Nor through the cotangents.
    """
    adjoint: dict[int, Scalar] = {}
    for output, cotangent in zip(outputs, cotangents, strict=True):
        if isinstance(output, Expression):
            adjoint[output.index] = add(adjoint.get(output.index, 0.0), cotangent)
    targets = {expression.index for expression in wanted}
    stops = {expression.index for expression in held if isinstance(expression, Expression)}
    depends = _dependent(graph, targets, stops)
    for index in range(max(adjoint, default=-1), -1, -1):
        above = adjoint.get(index, 0.0)
        if index not in depends or is_zero(above) or index in targets:
            continue
        node = graph.nodes[index]
        partials = _partials(graph, index, node, above)
        for operand, partial in zip(node.operands, partials, strict=True):
            if operand in depends:
                adjoint[operand] = add(adjoint.get(operand, 0.0), partial)
    return [adjoint.get(expression.index, 0.0) for expression in wanted]


def _dependent(graph: Graph, targets: set[int], stops: set[int]) -> set[int]:
    """Nodes that depend on ``targets`` by a way that avoids ``stops``."""
    depends: set[int] = set()
    for index, node in enumerate(graph.nodes):
        if index not in stops and (index in targets or not depends.isdisjoint(node.operands)):
            depends.add(index)
    return depends


def _partials(graph: Graph, index: int, node: Node, above: Scalar) -> tuple[Scalar, ...]:
    """What a node's adjoint ``above`` adds to those of its operands."""
    x, *more = (_scalar(graph, operand) for operand in node.operands)
    result = Expression(graph, index)
    match node.operation:
        case "+":
            return above, above
        case "-":
            return above, negate(above)
        case "negate":
            return (negate(above),)
        case "*":
            return multiply(above, more[0]), multiply(above, x)
        case "/":
            share = above / more[0]
            return share, negate(multiply(share, result))
        case "sqrt":
            return (multiply(0.5, above) / result,)
        case "sin":
            return (multiply(above, x.cos()),)
        case "cos":
            return (negate(multiply(above, x.sin())),)
    raise AssertionError(node.operation)


def _scalar(graph: Graph, index: int) -> Scalar:
    node = graph.nodes[index]
    return node.value if node.operation == "constant" else Expression(graph, index)
