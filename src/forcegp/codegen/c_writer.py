"""Graphs as C: the same text for one state (`real` is a double, C99) and for several in the lanes of vector registers.

A long program is cut into functions, which compilers need; what later ones use waits in an array. Functions of lanes
(Cody & Waite 1980; Muller, "Elementary Functions", 2016, ch. 5) are within three units of the last place.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from math import factorial

from forcegp.codegen.graph import LEAVES, Graph

LANE_BY_LANE = ("tan",)


@cache
def c_text(module: str, file: str) -> str:
    """A file beside this module."""
    return (files(module.rpartition(".")[0]) / file).read_text(encoding="ascii")


def sections(module: str, file: str) -> dict[str, str]:
    """The parts of a file, by the names above them: `//// NAME`."""
    return dict(re.findall(r"^//// (\S+)\n(.*?)(?=^////|\Z)", c_text(module, file), re.MULTILINE | re.DOTALL))


def filled(text: str, words: Mapping[str, object]) -> str:
    """The text with what stands for every `@WORD@`."""
    return re.sub("@([A-Z_0-9]+)@", lambda found: str(words[found[1]]), text)


def _horner(coefficients: list[float], variable: str) -> str:
    text = f"R({coefficients[0].hex()})"
    for value in coefficients[1:]:
        text = f"({text} * {variable} + {value.hex()})"
    return text


_EXPM1 = _horner([1.0 / factorial(n) for n in range(14, 0, -1)], "r")
_SIN = _horner([(-1.0) ** n / factorial(2 * n + 1) for n in range(7, -1, -1)], "z")
_COS = _horner([(-1.0) ** n / factorial(2 * n) for n in range(8, -1, -1)], "z")
_ATANH = _horner([2.0 / (2 * n + 1) for n in range(11, 0, -1)], "z")
STATEMENTS = 500  # per part
LONG_PART = 2500  # of dynamics, whose values are used again soon: 10-20 % faster, compiled as fast

ROWS = c_text(__name__, "rows.h")  # between rows of numbers, one per state, and lanes

SCALAR_NAMES = {"absolute": "fabs", "power": "pow"}
INFIX = {"add": "+", "subtract": "-", "multiply": "*", "divide": "/"}
COMPARED = {"less": "<", "at_most": "<=", "equal": "=="}


@dataclass(frozen=True)
class Program:
    """Named vectors of nodes from named vectors of inputs, in the order of the graph's; all `positive` must be > 0."""

    graph: Graph
    inputs: dict[str, int]
    outputs: Mapping[str, Sequence[int]]
    positive: Sequence[int] = ()

    @property
    def nodes(self) -> list[int]:
        """All outputs, then what must be positive."""
        return [node for vector in self.outputs.values() for node in vector] + list(self.positive)


def write_function(
    name: str,
    graph: Graph,
    outputs: Sequence[int],
    lanes: int,
    tables: Sequence[str] = (),
    most: int = STATEMENTS,
    numbers: dict[str, int] | None = None,
) -> str:
    """`static void NAME(const double *const *t, long live, const real *x, real *y)`: y from x in `live` lanes.

    `t` are the tables of the C functions that the graph calls, in the order of their names in `tables`. A function
    that it is cut into has at `most` so many statements. Constants are in the text, or in the table `t[NUMBERS]`,
    where `numbers` notes the place of each: the text is that of all graphs of this form then.
    """
    wanted, made = set(outputs), graph.nodes
    needed = [node for node in graph.needed(outputs) if node in wanted or made[node][0] not in LEAVES]
    # outputs of a call follow it at once, for its array is not kept
    order = sorted(needed, key=lambda node: (made[node][1], node) if made[node][0] == "output" else (node, -1))
    parts = [order[k : k + most] for k in range(0, len(order), most)] or [[]]
    places, waiting = _places(graph, parts)
    stores: dict[int, list[int]] = {}
    for position, node in enumerate(outputs):
        stores.setdefault(node, []).append(position)
    arguments = "const double *const *t, long live, const real *x, real *y"
    text: list[str] = []
    looked_up: dict[tuple, int] = {}
    for number, nodes in enumerate(parts):
        here = {node for node in nodes if graph.nodes[node][0] != "call"}

        def operand(node: int, here: set[int] = here) -> str:
            operation, *rest = graph.nodes[node]
            if operation == "constant":
                written = _number(rest[0])
                if numbers is None or "/" in written:  # neither NaN nor infinity is a number
                    return f"({written})"
                return f"(n[{numbers.setdefault(written, len(numbers))}])"
            return f"x[{rest[0]}]" if operation == "input" else f"x{node}" if node in here else f"w[{places[node][1]}]"

        text.append(f"static APART void {name}_{number}({arguments}, real *w) {{")
        text.append("  (void)t; (void)live; (void)x; (void)y; (void)w;")
        if numbers is not None:
            text.append("  const double *restrict const n = t[NUMBERS]; (void)n;")
        for node in nodes:
            operation, *rest = graph.nodes[node]
            if operation == "call":
                given = ", ".join(_as_real(graph, k, operand) for k in graph.operands(node))
                text.append(f"  real c{node}[{graph.outputs_of[node]}]; {{ const real z[] = {{{given}}};")
                text.append(f"  {rest[0]}(t[{tables.index(rest[0])}], live, z, c{node}); }}")
                continue
            if operation == "look up":
                table = f"{name}_table{looked_up.setdefault(rest[0], len(looked_up))}"
                text.append(f"  real x{node}; for (int k = 0; k < LANES; k++)")
                place = f"AT({operand(rest[1])}, k)"  # NaN where a state has overflowed
                inside = f"{place} >= 0.0 && {place} < {len(rest[0])}.0"
                text.append(f"    AT(x{node}, k) = {inside} ? {table}[(int){place}] : NAN;")
            elif operation == "output":
                text.append(f"  const real x{node} = c{rest[0]}[{rest[1]}];")
            elif operation not in LEAVES:
                value = c_value(graph, node, operand, lambda x, of=operand: _as_real(graph, x, of), lanes)
                text.append(f"  const real x{node} = {value};")
            text += [f"  y[{position}] = {_as_real(graph, node, operand)};" for position in stores.get(node, ())]
            if node in places:
                text.append(f"  w[{places[node][1]}] = x{node};")
        text.append("}")
    text.append(f"static APART void {name}({arguments}) {{\n  real w[{max(waiting, 1)}];")
    text += [f"  {name}_{number}(t, live, x, y, w);" for number in range(len(parts))]
    text.append("}")
    contents = {k: ", ".join(map(_number, table)) for table, k in looked_up.items()}
    constants = [f"static const double {name}_table{k}[] = {{{numbers}}};" for k, numbers in contents.items()]
    return "\n".join(constants + text)


def write_program(program: Program, lanes: int, statements: int = LONG_PART) -> str:
    """The C text of a program, whose function is `evaluate`."""
    text = write_function("program", program.graph, program.nodes, lanes, (), statements)
    return "\n".join([head(lanes), text, write_entry(program, "program")])


def head(lanes: int) -> str:
    """What stands before all functions: the type `real`, and functions on it."""
    if lanes == 1:
        return "#include <math.h>\n" + c_text(__name__, "scalar.h")
    words = {"LANES": lanes, "EXPM1": _EXPM1, "SIN": _SIN, "COS": _COS, "ATANH": _ATANH}
    by_lane = (f"INLINE real r_{name}(real x) {{ return by_lane({name}, x); }}\n" for name in LANE_BY_LANE)
    return filled(c_text(__name__, "lanes.h"), words) + "".join(by_lane)


def write_entry(program: Program, function: str, finish: Mapping[str, tuple[str, int]] | None = None) -> str:
    """`evaluate(first, last, t, a0, s0, ..., o0, r0, ...)`: all states; strides `s`, `r`, 0 for one row.

    `finish` names outputs that a C function (t, y, out) makes, and their lengths. Returns bits: 1 for inputs that are
    not finite, 2 for what should be positive, 4 for results that are not finite.
    """
    finish, arguments = finish or {}, [f"const double *a{k}, long s{k}" for k in range(len(program.inputs))]
    arguments += [f"double *o{k}, long r{k}" for k in range(len(program.outputs))]
    text = [
        ROWS,
        f"int evaluate(long first, long last, const double *const *t, {', '.join(arguments)}) {{",
        f"  real x[{max(sum(program.inputs.values()), 1)}], y[{max(len(program.nodes), 1)}];",
        "  int found = 0;",
        "  for (long i = first; i < last; i += LANES) {",
        "    const long live = last - i < LANES ? last - i : LANES;",
    ]
    place = 0
    for k, size in enumerate(program.inputs.values()):
        text += [f"    if (s{k} || i == first) found |= rows_read(a{k} + i * s{k}, s{k}, {size}, live, x + {place});"]
        place += size
    text.append(f"    {function}(t, live, x, y);")
    place = 0
    for k, (name, vector) in enumerate(program.outputs.items()):
        size = len(vector)
        if name in finish:
            made, final = finish[name]
            text += [
                f"    for (int k = 0; k < live; k++) {{ double *p = o{k} + (i + k) * r{k}, g[{size}];",
                f"      for (int j = 0; j < {size}; j++) g[j] = AT(y[{place} + j], k);",
                f"      {made}(t, g, p); for (int j = 0; j < {final}; j++) found |= !(p[j] - p[j] == 0.0) << 2; }}",
            ]
        else:
            text.append(f"    found |= rows_write(y + {place}, {size}, live, o{k} + i * r{k}, r{k}) << 2;")
        place += size
    if program.positive:
        every = f"for (int j = {place}; j < {place + len(program.positive)}; j++) for (int k = 0; k < live; k++)"
        text.append(f"    {every} found |= !(AT(y[j], k) > 0.0) << 1;")
    text.append("  }")
    text.append("  return found;\n}")
    return "\n".join(text)


def c_value(graph: Graph, node: int, operand: Callable[[int], str], as_real: Callable[[int], str], lanes: int) -> str:
    """The C text of an operation; `as_real` is that of an operand where a function needs the type `real`."""
    operation, *rest = graph.nodes[node]
    if operation in INFIX:
        return f"{operand(rest[0])} {INFIX[operation]} {operand(rest[1])}"
    if operation == "negate":
        return f"-{operand(rest[0])}"
    given = [as_real(x) for x in rest]
    if lanes > 1:
        return f"r_{operation}({', '.join(given)})"
    if operation in COMPARED:
        return f"{given[0]} {COMPARED[operation]} {given[1]} ? 1.0 : 0.0"
    if operation == "choose":
        return f"{given[0]} != 0.0 ? {given[1]} : {given[2]}"
    return f"{SCALAR_NAMES.get(operation, operation)}({', '.join(given)})"


def _as_real(graph: Graph, node: int, operand: Callable[[int], str]) -> str:
    return f"R{operand(node)}" if graph.nodes[node][0] == "constant" else operand(node)


def _number(value: float) -> str:
    if value == value and abs(value) != float("inf"):
        return value.hex()
    return "0.0 / 0.0" if value != value else f"{math.copysign(1.0, value)} / 0.0"


def _places(graph: Graph, parts: list[list[int]]) -> tuple[dict[int, tuple[int, int]], int]:
    """Last part that uses a node and its place in the waiting array, for nodes of earlier parts; size of that array."""
    last_part = 0
    for number in range(1, len(parts)):  # no call is cut from its outputs, of which there may be more than statements
        while parts[number] and graph.nodes[parts[number][0]][0] == "output":
            parts[last_part].append(parts[number].pop(0))
        last_part = number if parts[number] else last_part
    made = {node: part for part, nodes in enumerate(parts) for node in nodes}
    last: dict[int, int] = {}
    for node, part in made.items():
        if graph.nodes[node][0] == "output":
            continue
        for operand in graph.operands(node):
            if made.get(operand, part) < part and graph.nodes[operand][0] not in LEAVES:
                last[operand] = max(part, last.get(operand, 0))
    places: dict[int, tuple[int, int]] = {}
    free: list[int] = []
    size = 0
    for part, nodes in enumerate(parts):
        free += [place for until, place in places.values() if until == part - 1]
        for node in nodes:
            if node in last:
                if not free:
                    free, size = [size], size + 1
                places[node] = last[node], free.pop()
    return places, size
