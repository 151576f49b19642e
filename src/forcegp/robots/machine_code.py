"""Programs as C: several states at once in the lanes of vector registers, one straight line of arithmetic.

The only functions that the C code computes are + - * / and square roots; sines and cosines of inputs are inputs too,
named ``sin q`` for an input ``q`` (torch computes them vectorised). GCC and Clang understand vector types on every
processor (`__attribute__((vector_size))`).
"""

from __future__ import annotations

from forcegp.robots.dynamics_programs import Program

# Arrays are given row by row, one row per state; a stride of 0 serves all states with one row. An output of stride 0
# receives the sum over the states. The lanes past the last state repeat it: what they store is the same once more.
HEAD = """\
typedef double V __attribute__((vector_size({bytes})));
typedef long long B __attribute__((vector_size({bytes})));

int evaluate(long first, long last, const double *const *in, const long *in_stride, double *const *out,
             const long *out_stride) {{
  B good = {{{all_good}}};
{sums}  for (long i = first; i < last; i += {lanes}) {{
"""


def write_c(program: Program, inputs: tuple[str, ...], lanes: int) -> str:
    """Source of ``evaluate``, which returns whether all that must be positive was."""
    graph = program.graph
    needed = graph.needed([scalar for vector in program.outputs.values() for scalar in vector] + program.positive)
    arrays = input_arrays(inputs)
    stores: dict[int, list[str]] = {}
    for array, (_, vector) in enumerate(program.outputs.items()):
        for position, scalar in enumerate(vector):
            stores.setdefault(graph.index(scalar), []).append(f"STORE{array}({position}, {{0}});")
    for scalar in program.positive:
        stores.setdefault(graph.index(scalar), []).append("good &= (B)({0} > (V){{}});")
    sizes = {array: len(vector) for array, (name, vector) in enumerate(program.outputs.items()) if name == "inertias"}
    lines = [
        HEAD.format(
            bytes=8 * lanes,
            lanes=lanes,
            all_good=", ".join(["-1"] * lanes),
            sums="".join(f"  V sum{array}[{size}] = {{}};\n" for array, size in sizes.items()),
        )
    ]
    every = range(lanes)
    lines += [f"    const long l{k} = i + {k} < last ? i + {k} : last - 1;" for k in every]
    for array in range(len(arrays)):
        lines += [f"    const double *a{array}_{k} = in[{array}] + l{k} * in_stride[{array}];" for k in every]
    for array in range(len(program.outputs)):
        lines += [f"    double *o{array}_{k} = out[{array}] + l{k} * out_stride[{array}];" for k in every]
    if sizes:
        lines.append(f"    const V live = {{{', '.join(f'i + {k} < last' for k in every)}}};")
    for array in range(len(program.outputs)):
        store = " ".join(f"o{array}_{k}[j] = x[{k}];" for k in every)
        if array in sizes:
            store = f"if (out_stride[{array}]) {{ {store} }} else sum{array}[j] += live * x;"
        lines.append(f"#define STORE{array}(j, value) {{ const V x = value; {store} }}")
    loads = {name: array for array, name in enumerate(arrays)}
    written: set[int] = set()

    def load(index: int, name: str, position: int) -> None:
        values = ", ".join(f"a{loads[name]}_{k}[{position}]" for k in every)
        finish(index, f"{{{values}}}")

    def finish(index: int, value: str) -> None:
        lines.append(f"    const V x{index} = {value};")
        lines.extend("    " + store.format(f"x{index}") for store in stores.get(index, ()))
        written.add(index)

    def operand(index: int) -> str:
        node = graph.nodes[index]
        if node.operation == "constant":
            return f"({node.value.hex()})"
        if node.operation == "input" and index not in written:  # late, to hold few registers at a time
            load(index, node.name, node.position)
        return f"x{index}"

    for index in needed:
        node = graph.nodes[index]
        match node.operation:
            case "constant":
                if index in stores:
                    finish(index, f"{node.value.hex()} + (V){{}}")
            case "input":
                if index in stores and index not in written:
                    load(index, node.name, node.position)
            case "sin" | "cos":
                given = graph.nodes[node.operands[0]]
                load(index, f"{node.operation} {given.name}", given.position)
            case "negate":
                finish(index, f"-{operand(node.operands[0])}")
            case "sqrt":
                x = operand(node.operands[0])
                finish(index, f"{{{', '.join(f'__builtin_sqrt({x}[{k}])' for k in every)}}}")
            case operation:
                x, y = (operand(index) for index in node.operands)
                finish(index, f"{x} {operation} {y}")
    lines.append("  }")
    for array, size in sizes.items():
        total = " + ".join(f"sum{array}[j][{k}]" for k in every)
        lines.append(f"  if (!out_stride[{array}]) for (int j = 0; j < {size}; j++) out[{array}][j] += {total};")
    lines += [f"  return {' && '.join(f'good[{k}]' for k in every)};", "}", ""]
    return "\n".join(lines)


def input_arrays(inputs: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the arrays that ``evaluate`` takes: the program's inputs, then sine and cosine of q."""
    return (*inputs, "sin q", "cos q")
