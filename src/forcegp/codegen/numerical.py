"""A graph evaluated by NumPy, on many points at once: for tables, and for tests."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import erf

from forcegp.codegen.graph import Graph

FUNCTIONS: dict[str, Any] = {
    **{name: getattr(np, name) for name in ("absolute", "sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp")},
    **{name: getattr(np, name) for name in ("log", "log1p", "expm1", "add", "subtract", "multiply", "divide", "power")},
    **{name: getattr(np, f"arc{name[1:]}") for name in ("asin", "acos", "atan", "asinh", "atan2")},
    "negate": np.negative,
    "erf": erf,
    "less": lambda x, y: np.where(x < y, 1.0, 0.0),
    "at_most": lambda x, y: np.where(x <= y, 1.0, 0.0),
    "equal": lambda x, y: np.where(x == y, 1.0, 0.0),
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
