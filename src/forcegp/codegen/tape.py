"""A function of few numbers as a tape: straight-line arithmetic on scalars, from which machine code is run.

Equal operations on equal operands are recorded once, and what constants decide (products with zero, sums of known
numbers) is never recorded. Tapes are what automatic differentiation works on (Griewank & Walther, "Evaluating
Derivatives", 2008, ch. 4); here they also take the place of the many small tensor operations of rigid-body dynamics,
whose cost at a single state is that of calling them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

ZERO, ONE = 0, 1
"""Numbers of the nodes that hold these constants."""

UNARY: dict[str, Callable[[float], float]] = {
    "negate": lambda x: -x,
    "absolute": abs,
    "sqrt": math.sqrt,
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "asin": math.asin,
    "acos": math.acos,
    "atan": math.atan,
    "sinh": math.sinh,
    "cosh": math.cosh,
    "tanh": math.tanh,
    "asinh": math.asinh,
    "exp": math.exp,
    "log": math.log,
    "log1p": math.log1p,
    "expm1": math.expm1,
    "erf": math.erf,
}
BINARY: dict[str, Callable[[float, float], float]] = {
    "add": lambda x, y: x + y,
    "subtract": lambda x, y: x - y,
    "multiply": lambda x, y: x * y,
    "divide": lambda x, y: x / y,
    "power": math.pow,
    "atan2": math.atan2,
    "less": lambda x, y: float(x < y),
    "at_most": lambda x, y: float(x <= y),
    "equal": lambda x, y: float(x == y),
}
TERNARY = ("choose", "multiply_add", "multiply_subtract", "subtract_multiplied")
"""m != 0 ? x : y; x y + z; x y - z; z - x y. The last three are made by `Tape.program` only."""

CODES = {name: code for code, name in enumerate((*UNARY, *BINARY, *TERNARY))}
"""The number of every operation in a program."""

COMMUTATIVE = ("add", "multiply", "equal")
FUSED = {"add": ("multiply_add", "multiply_add"), "subtract": ("multiply_subtract", "subtract_multiplied")}
"""What a sum or difference becomes when its first or its second operand is a product that nothing else uses."""


@dataclass(frozen=True, eq=False)
class Program:
    """A tape ready to be run: every instruction reads and writes slots.

    `instructions` (n, 5) int32 are operation, slot of the result, and slots of up to three operands. Slots begin with
    the inputs, then the `constants`; those after are used again when their value is no longer needed.
    """

    inputs: int
    slots: int
    constants: np.ndarray
    instructions: np.ndarray
    outputs: np.ndarray


class Tape:
    """Operations recorded so far; the operands of a node have smaller numbers."""

    def __init__(self, inputs: int) -> None:
        self._nodes: list[tuple] = []
        self._found: dict[tuple, int] = {}
        self._record(("constant", 0.0))
        self._record(("constant", 1.0))
        self.inputs = [self._record(("input", position)) for position in range(inputs)]

    def constant(self, value: float | int) -> int:
        """The node of a number."""
        return self._record(("constant", float(value) + 0.0))  # -0.0 becomes 0.0

    def value(self, node: int) -> float | None:
        """The number that a node holds whatever the inputs are, or None."""
        operation, *operands = self._nodes[node]
        return operands[0] if operation == "constant" else None

    def apply(self, operation: str, *operands: int) -> int:
        """The node of an operation on nodes."""
        known = [self.value(operand) for operand in operands]
        if operation == "choose":
            if known[0] is not None:
                return operands[1] if known[0] else operands[2]
            return operands[1] if operands[1] == operands[2] else self._record((operation, *operands))
        if None not in known:
            return self.constant(_folded(operation, known))
        simpler = self._simplified(operation, operands)
        if simpler is not None:
            return simpler
        return self._record((operation, *(sorted(operands) if operation in COMMUTATIVE else operands)))

    def sum(self, nodes: Sequence[int]) -> int:
        """The sum of nodes."""
        total = ZERO
        for node in nodes:
            total = self.apply("add", total, node)
        return total

    def dot(self, left: Sequence[int], right: Sequence[int]) -> int:
        """sum_k left_k right_k."""
        return self.sum([self.apply("multiply", x, y) for x, y in zip(left, right, strict=True)])

    def program(self, outputs: Sequence[int]) -> Program:
        """What computes these nodes, products and sums fused where nothing else needs the product."""
        uses = Counter(outputs)
        for node in self._needed(outputs):
            uses.update(self._operands(node))
        fused: set[int] = set()
        steps: list[tuple[int, tuple]] = []
        for node in self._needed(outputs):
            entry = self._nodes[node]
            if entry[0] in FUSED:
                for position in (1, 0):
                    product = entry[1 + position]
                    if self._nodes[product][0] == "multiply" and uses[product] == 1 and product not in fused:
                        fused.add(product)
                        other = entry[2 - position]
                        entry = (FUSED[entry[0]][position], *self._nodes[product][1:], other)
                        break
            steps.append((node, entry))
        return _allocated([step for step in steps if step[0] not in fused], outputs, len(self.inputs))

    def _simplified(self, operation: str, operands: tuple[int, ...]) -> int | None:
        """A node that is equal whatever the inputs are and needs no new operation, or None."""
        x = operands[0]
        if operation == "negate" and self._nodes[x][0] == "negate":
            return self._nodes[x][1]
        if len(operands) < 2:
            return None
        y = operands[1]
        match operation:
            case "add" if ZERO in operands:
                return y if x == ZERO else x
            case "subtract" if ZERO in operands:
                return x if y == ZERO else self.apply("negate", y)
            case "multiply" if ZERO in operands:
                return ZERO
            case "multiply" if ONE in operands:
                return y if x == ONE else x
            case "divide" if x == ZERO or y == ONE:
                return x
            case _:
                return None

    def _operands(self, node: int) -> tuple[int, ...]:
        entry = self._nodes[node]
        return () if entry[0] in ("constant", "input") else entry[1:]

    def _needed(self, outputs: Sequence[int]) -> list[int]:
        wanted = set(outputs)
        for node in range(max(wanted, default=-1), -1, -1):
            if node in wanted:
                wanted.update(self._operands(node))
        return sorted(wanted)

    def _record(self, entry: tuple) -> int:
        found = self._found.get(entry)
        if found is None:
            found = self._found[entry] = len(self._nodes)
            self._nodes.append(entry)
        return found


def _folded(operation: str, operands: Sequence[float | None]) -> float:
    """An operation on known numbers; outside its domain NaN, as a processor has it."""
    try:
        return {**UNARY, **BINARY}[operation](*operands)  # type: ignore[arg-type]  # the caller has checked that none is None
    except (ValueError, ZeroDivisionError, OverflowError):
        return math.nan


def _allocated(steps: list[tuple[int, tuple]], outputs: Sequence[int], inputs: int) -> Program:
    """Slots for all nodes; one is free again after the last instruction that reads it."""
    last: dict[int, int] = {}
    for position, (_, (operation, *operands)) in enumerate(steps):
        if operation not in ("constant", "input"):
            last.update(dict.fromkeys(operands, position))
    last.update(dict.fromkeys(outputs, len(steps)))
    constants = [(node, entry[1]) for node, entry in steps if entry[0] == "constant"]
    slot = {node: entry[1] for node, entry in steps if entry[0] == "input"}
    slot |= {node: inputs + position for position, (node, _) in enumerate(constants)}
    kept = set(slot)
    count, free, instructions = inputs + len(constants), [], []
    for position, (node, (operation, *operands)) in enumerate(steps):
        if operation in ("constant", "input"):
            continue
        read = [slot[operand] for operand in operands]
        free += [slot[x] for x in dict.fromkeys(operands) if x not in kept and last[x] == position]
        if not free:
            free.append(count)
            count += 1
        slot[node] = free.pop()
        instructions.append([CODES[operation], slot[node], *read, *([0] * (3 - len(read)))])
    return Program(
        inputs,
        count,
        np.array([value for _, value in constants], dtype=np.float64),
        np.array(instructions, dtype=np.int32).reshape(-1, 5),
        np.array([slot[node] for node in outputs], dtype=np.int32),
    )
