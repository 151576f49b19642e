"""Programs as C: several states at once in the lanes of vector registers, in straight lines of arithmetic.

The only functions that the C code computes are + - * / and square roots; sines and cosines of inputs are inputs too,
named ``sin q`` for an input ``q`` (torch computes them vectorised). GCC and Clang understand vector types on every
processor (`__attribute__((vector_size))`).

A long program is cut into parts, functions of their own: in one function, twice as much takes a compiler far more than
twice as long. Values that later parts use wait in an array, whose places are used again.
"""

from __future__ import annotations

from collections.abc import Sequence

from forcegp.robots.dynamics_programs import DynamicsProgram

STATEMENTS = 500  # per part

# Arrays are given row by row, one row per state; a stride of 0 serves all states with one row. An output of stride 0
# receives the sum over the states. The lanes past the last state repeat it: what they store is the same once more.
HEAD = """\
typedef double V __attribute__((vector_size({bytes})));
typedef long long B __attribute__((vector_size({bytes})));
typedef struct {{
  const double *in[{inputs}][{lanes}];
  double *out[{outputs}][{lanes}];
  const long *out_stride;
  V live, wait[{waiting}]{sums};
  B good;
}} Work;
"""

TAIL = """\
int evaluate(long first, long last, const double *const *in, const long *in_stride, double *const *out,
             const long *out_stride) {{
  Work w = {{.out_stride = out_stride, .good = {{{all_good}}}}};
  for (long i = first; i < last; i += {lanes}) {{
    for (int k = 0; k < {lanes}; k++) {{
      const long row = i + k < last ? i + k : last - 1;
      for (int j = 0; j < {inputs}; j++) w.in[j][k] = in[j] + row * in_stride[j];
      for (int j = 0; j < {outputs}; j++) w.out[j][k] = out[j] + row * out_stride[j];
      w.live[k] = i + k < last;
    }}
    {calls}
  }}
{sums}  for (int k = 0; k < {lanes}; k++) if (!w.good[k]) return 0;
  return 1;
}}
"""
SUM = """\
  if (!out_stride[{array}])
    for (int j = 0; j < {size}; j++)
      for (int k = 0; k < {lanes}; k++) out[{array}][j] += w.sum{array}[j][k];
"""


def input_arrays(inputs: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the arrays that ``evaluate`` takes: the program's inputs, then sine and cosine of q."""
    return (*inputs, "sin q", "cos q")


def write_c(program: DynamicsProgram, inputs: tuple[str, ...], lanes: int, statements: int = STATEMENTS) -> str:
    """Source of ``evaluate``, which returns whether all that must be positive was."""
    graph, arrays = program.graph, input_arrays(inputs)
    stores = _stores(program)
    order = _order(program, stores)
    parts = [order[k : k + statements] for k in range(0, len(order), statements)]
    places, waiting = _places(program, parts)
    sums = {array: len(vector) for array, (name, vector) in enumerate(program.outputs.items()) if name == "inertias"}
    sizes = {"lanes": lanes, "inputs": len(arrays), "outputs": len(program.outputs)}
    fields = "".join(f", sum{array}[{size}]" for array, size in sums.items())
    text = [HEAD.format(bytes=8 * lanes, waiting=max(waiting, 1), sums=fields, **sizes)]
    for array in range(len(program.outputs)):
        store = " ".join(f"o{array}_{k}[j] = x[{k}];" for k in range(lanes))
        if array in sums:
            store = f"if (w->out_stride[{array}]) {{ {store} }} else w->sum{array}[j] += w->live * x;"
        text.append(f"#define STORE{array}(j, value) {{ const V x = value; {store} }}")
    pointers = [f"  const double *a{j}_{k} = w->in[{j}][{k}];" for j in range(len(arrays)) for k in range(lanes)]
    pointers += [f"  double *o{j}_{k} = w->out[{j}][{k}];" for j in range(len(program.outputs)) for k in range(lanes)]

    def operand(index: int, here: set[int]) -> str:
        node = graph.nodes[index]
        if node.operation == "constant":
            return f"({node.value.hex()})"
        return f"x{index}" if index in here else f"w->wait[{places[index][1]}]"

    def value(index: int, here: set[int]) -> str:
        node = graph.nodes[index]
        if node.operation in ("input", "sin", "cos"):
            given = node if node.operation == "input" else graph.nodes[node.operands[0]]
            name = given.name if given is node else f"{node.operation} {given.name}"
            rows = (f"a{arrays.index(name)}_{k}[{given.position}]" for k in range(lanes))
            return f"{{{', '.join(rows)}}}"
        if node.operation == "constant":
            return f"{node.value.hex()} + (V){{}}"
        x, *more = (operand(each, here) for each in node.operands)
        if node.operation == "negate":
            return f"-{x}"
        if node.operation == "sqrt":
            return f"{{{', '.join(f'__builtin_sqrt({x}[{k}])' for k in range(lanes))}}}"
        return f"{x} {node.operation} {more[0]}"

    for part, indices in enumerate(parts):
        text += [f"static __attribute__((noinline)) void part{part}(Work *w) {{", *pointers]
        here: set[int] = set()
        for index in indices:
            text.append(f"  const V x{index} = {value(index, here)};")
            here.add(index)
            text += [f"  {store.format(f'x{index}')}" for store in stores.get(index, ())]
            if index in places:
                text.append(f"  w->wait[{places[index][1]}] = x{index};")
        text.append("}")
    text.append(
        TAIL.format(
            all_good=", ".join(["-1"] * lanes),
            calls=" ".join(f"part{part}(&w);" for part in range(len(parts))),
            sums="".join(SUM.format(array=array, size=size, lanes=lanes) for array, size in sums.items()),
            **sizes,
        )
    )
    return "\n".join(text)


def _stores(program: DynamicsProgram) -> dict[int, list[str]]:
    """What to do with the value of a node once it is there."""
    stores: dict[int, list[str]] = {}
    for array, vector in enumerate(program.outputs.values()):
        for position, scalar in enumerate(vector):
            stores.setdefault(program.graph.index(scalar), []).append(f"STORE{array}({position}, {{0}});")
    for scalar in program.positive:
        stores.setdefault(program.graph.index(scalar), []).append("w->good &= (B)({0} > (V){{}});")
    return stores


def _order(program: DynamicsProgram, stores: dict[int, list[str]]) -> list[int]:
    """Nodes in the order of their statements: inputs right before their first use, to hold few registers at a time."""
    nodes = program.graph.nodes
    order: dict[int, None] = {}
    for index in program.needed:
        node = nodes[index]
        if node.operation in ("+", "-", "*", "/", "negate", "sqrt"):
            order |= {each: None for each in node.operands if nodes[each].operation == "input"}
        elif node.operation in ("input", "constant") and index not in stores:
            continue
        order[index] = None
    return list(order)


def _places(program: DynamicsProgram, parts: Sequence[Sequence[int]]) -> tuple[dict[int, tuple[int, int]], int]:
    """Last part that uses a node and its place in the waiting array, for nodes of earlier parts; size of that array."""
    made = {index: part for part, indices in enumerate(parts) for index in indices}
    last: dict[int, int] = {}
    for index, part in made.items():
        if program.graph.nodes[index].operation in ("sin", "cos"):
            continue
        for operand in program.graph.nodes[index].operands:
            if made.get(operand, part) < part:
                last[operand] = max(part, last.get(operand, 0))
    places: dict[int, tuple[int, int]] = {}
    free: list[int] = []
    size = 0
    for part, indices in enumerate(parts):
        free += [place for until, place in places.values() if until == part - 1]
        for index in indices:
            if index in last:
                if not free:
                    free, size = [size], size + 1
                places[index] = last[index], free.pop()
    return places, size
