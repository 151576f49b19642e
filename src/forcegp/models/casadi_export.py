"""A posterior as a CasADi function, with all derivatives: for do-mpc, acados, IPOPT, and CasADi's own C.

The graph that programs are written from (`predictor_code`) becomes scalar expressions (SX); sums over centres become
products of matrices (MX), whose size does not grow with the derivatives. CasADi is an extra (LGPL): it is imported here
and only here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from forcegp.codegen.graph import Graph
from forcegp.errors import InvalidInput, MissingExtra
from forcegp.inference.kernel_sums import KernelSum
from forcegp.inference.one_input_calls import OneInputCall
from forcegp.models.predictor_code import PredictorCode
from forcegp.models.protocol import Posterior
from forcegp.models.structured.posterior import StructuredPosterior

NAMES = {"absolute": "fabs"}


def casadi_function(posterior: Posterior, *, name: str = "acceleration") -> Any:
    """The mean acceleration as a `casadi.Function` (q, v, u) -> a, each (nv,) in the units of `predict`.

    Differentiable as CasADi functions are (`jacobian`, `hessian`, `generate`, `map`, ...); no compiler is needed.
    Raises MissingExtra without CasADi, InvalidInput for other models than a StructuredGP and for operations that no
    graph holds.
    """
    try:
        import casadi
    except ImportError:
        raise MissingExtra(
            "casadi_function needs CasADi, which is not installed; pip install 'forcegp[casadi]'."
        ) from None
    if not isinstance(posterior, StructuredPosterior):
        raise InvalidInput(f"no program can be written of a {posterior.description}; export a StructuredGP.")
    code = posterior.code()
    x = [casadi.MX.sym(symbol, code.nv) for symbol in "qvu"]
    f = casadi.vertcat(*_latents(casadi, code, x)) if code.sums else casadi.MX(0, 1)
    return casadi.Function(name, x, [_physics(casadi, code)(*x, f)], ["q", "v", "u"], ["a"])


def _physics(casadi: Any, code: PredictorCode) -> Any:
    """(q, v, u, f) -> a by scalars."""
    graph = code.physics
    vectors = [casadi.SX.sym(symbol, code.nv) for symbol in "qvu"]
    vectors.append(casadi.SX.sym("f", len(graph.inputs) - 3 * code.nv))
    scalars = [entry for vector in vectors for entry in casadi.vertsplit(vector)]
    return casadi.Function("physics", vectors, [casadi.vertcat(*expressed(casadi, graph, code.a, scalars))])


def _latents(casadi: Any, code: PredictorCode, x: Sequence[Any]) -> list[Any]:
    """E f of every process in the order of their numbers."""
    graph, found = Graph(3 * code.nv), {}
    copied = graph.copier(code.physics, dict(zip(code.physics.inputs, graph.inputs, strict=False)))
    vectors = [casadi.SX.sym(symbol, code.nv) for symbol in "qvu"]
    scalars = [entry for vector in vectors for entry in casadi.vertsplit(vector)]
    for part in code.sums:
        summed = part.summed if isinstance(part, OneInputCall) else part
        given = summed.given(graph, copied(code.features[summed.latents[0]]))
        operands = expressed(casadi, graph, given, scalars)
        z = casadi.Function("operands", vectors, [casadi.vertcat(*operands)])(*x)
        found |= dict(zip(summed.latents, _sum(casadi, summed, casadi.vertsplit(z)), strict=True))
    return [found[c] for c in sorted(found)]


def _sum(casadi: Any, part: KernelSum, z: Sequence[Any]) -> list[Any]:
    """sum_j w_cj k_c(z, z_j), all centres in one row."""
    known: dict[int, Any] = dict(zip(part.operands, z, strict=True))
    known |= {node: casadi.DM(row).T for node, row in zip(part.rows, part.row_values(), strict=True)}
    kernels = expressed(casadi, part.pair, list(part.kernels), [], known)
    return [
        casadi.mtimes(k, casadi.DM(weights.tolist())) + constant
        for k, weights, constant in zip(kernels, part.weights, part.constants, strict=True)
    ]


def expressed(
    casadi: Any, graph: Graph, nodes: Sequence[int], inputs: Sequence[Any], known: dict[int, Any] | None = None
) -> list[Any]:
    """Nodes of a graph without calls as CasADi expressions; `known` are those that are there already."""
    found = dict(known or {})
    for node in graph.needed(nodes, found):
        if node in found:
            continue
        operation, *rest = graph.nodes[node]
        given = [found[x] for x in graph.operands(node)]
        match operation:
            case "constant":
                found[node] = rest[0]
            case "input":
                found[node] = inputs[rest[0]]
            case "add" | "subtract" | "multiply" | "divide":
                x, y = given
                found[node] = {"add": x + y, "subtract": x - y, "multiply": x * y}.get(operation)
                if operation == "divide":
                    found[node] = x / y
            case "negate":
                found[node] = -given[0]
            case "less" | "at_most" | "equal":
                x, y = given
                found[node] = {"less": x < y, "at_most": x <= y, "equal": x == y}[operation]
            case "choose":
                found[node] = casadi.if_else(*given)
            case "look up":
                value = rest[0][0]
                for place, entry in enumerate(rest[0][1:], 1):
                    value = casadi.if_else(given[0] >= place, entry, value)
                found[node] = value
            case _:
                found[node] = getattr(casadi, NAMES.get(str(operation), str(operation)))(*given)
    return [found[node] for node in nodes]
