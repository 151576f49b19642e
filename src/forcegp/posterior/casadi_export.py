"""A posterior as a CasADi function, with all derivatives: for do-mpc, acados, IPOPT, and CasADi's own C.

The graph of programs becomes scalar expressions (SX), sums over centres products of matrices (MX), whose size does not
grow with derivatives. CasADi is an extra (LGPL), imported here only.
"""

import math
import operator
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from forcegp.atomic_files import write_text
from forcegp.codegen.graph import ARITHMETIC, COMPARED, FUNCTIONS, Copier, Graph, interpreted
from forcegp.codegen.tracing import trace
from forcegp.errors import NumericalError, require_type, required_extra
from forcegp.inference.prepared_kernels import KernelSum
from forcegp.integration import INTEGRATORS, integrator_named
from forcegp.posterior.c_export import rounding
from forcegp.posterior.c_files import identifier
from forcegp.posterior.posterior import Posterior
from forcegp.posterior.preparation import rows_for, sample_states
from forcegp.posterior.programs import Programs, require_step

STATES = 100
TOLERANCE, STEP_TOLERANCE = 1e-11, 1e-8
"""Largest difference from `predict`, relative to the largest value; implicit steps end at 1e-9."""


def casadi_function(
    posterior: Posterior, *, steps: float | None = None, integrator: str = "symplectic-euler", name: str | None = None
) -> Any:
    """The mean acceleration as a `casadi.Function` (q, v, u) -> a, (nq,), (nv,), (nu,) -> (nv,) in units of `predict`.

    With `steps` (q, v, u) -> (q_next, v_next), a step of so many seconds by the `integrator`: "symplectic-euler",
    "rk4", or "implicit-midpoint" by CasADi's Newton method; and memory_next, columns of u, where laws remember. Where a
    base moves steps are explicit, a second result of the acceleration is q_dot (nq,), and quaternions count as their
    directions. Raises MissingExtra without CasADi, InvalidInput for what no graph holds, steps and integrators.
    """
    casadi: Any = required_extra("casadi", "casadi", "casadi_function")
    require_type("posterior", posterior, Posterior)
    code, name = posterior.programs(), casadi.Function.fix_name(name or ("acceleration" if steps is None else "step"))
    x = [casadi.MX.sym(symbol, size) for symbol, size in zip("qvu", code.sizes, strict=True)]
    f = casadi.vertcat(*_latents(casadi, code, x)) if code.sums else casadi.MX(0, 1)
    given = *code.sizes, sum(len(part.latents) for part in code.sums)
    physics = _function(casadi, "physics", code.traced.graph, code.traced.a, given)
    results, names, space = [physics(*x, f)], ["a"], code.space
    acceleration = casadi.Function(name, x, results, ["q", "v", "u"], names)
    if steps is None:
        if space.is_vector_space:
            return acceleration
        moved = _of_space(casadi, lambda q, v: (space.tangent(q) @ v[..., None])[..., 0], code.sizes[:2])
        return casadi.Function(name, x, [*results, moved(*x[:2])], ["q", "v", "u"], [*names, "q_dot"])
    require_step(steps, integrator, posterior.model)
    there, names = _stepped(casadi, code, acceleration, x, float(steps), integrator), ["q_next", "v_next"]
    if code.remembered is not None:
        graph, nodes, sizes = code.remembered
        first = posterior.model.memory_column
        z = x[2][first : first + sizes[0]]
        there.append(_function(casadi, "remember", graph, nodes, sizes)(z, x[0], there[0], float(steps)))
        names.append("memory_next")
    return casadi.Function(name, x, there, ["q", "v", "u"], names)


def export_casadi(
    posterior: Posterior,
    folder: str | Path,
    *,
    steps: float | None = None,
    integrator: str = "symplectic-euler",
    name: str | None = None,
) -> dict[str, float]:
    """Write NAME.casadi, and with `steps` NAME_step.casadi, to a folder, for `casadi.Function.load`.

    Returns the largest relative difference from `predict` (a predictor's `step`) around the training data by file.
    Raises as `casadi_function`, and NumericalError where they differ.
    """
    called = identifier(name or posterior.model.robot.name)
    functions = {called: casadi_function(posterior, name=called)}
    casadi: Any = required_extra("casadi", "casadi", "export_casadi")
    rows = rows_for(posterior.training, posterior.trained, posterior.model)
    q, v, u = sample_states(rows, posterior.model.robot.space, STATES, 2, STATES // 3)
    expected = {called: posterior.predict(q, v, u, covariance=False).mean}
    if steps is not None:
        step = f"{called}_step"
        functions[step] = casadi_function(posterior, steps=steps, integrator=integrator, name=step)
        predictor = posterior.predictor(covariance="none", compile=False)
        expected[step] = torch.cat(predictor.step(q, v, u, steps, integrator), dim=-1)
    lost, found = rounding(posterior, q, v, u), {}
    for file, function in functions.items():
        try:
            parts = function.map(len(q))(*(x.numpy().T for x in (q, v, u)))
        except RuntimeError:  # many lines
            seen = f"CasADi finds no step of {steps:g} s by {integrator} somewhere near the training data"
            advice = "give shorter steps, or export to C, whose Newton method shortens what overshoots."
            raise NumericalError(f"{seen}, so nothing is written; {advice}") from None
        made = np.concatenate([np.array(x) for x in (parts if isinstance(parts, tuple) else (parts,))]).T
        apart = made[:, : expected[file].shape[1]] - expected[file].numpy()
        worst = float(np.abs(apart).max() / expected[file].abs().max())
        if not worst <= max(STEP_TOLERANCE if file != called else TOLERANCE, lost):
            seen = f"{file}.casadi and forcegp differ by {worst:.2g} of the largest value, so nothing is written"
            raise NumericalError(f"{seen}; export to C, or fit with fewer points, which cancel less.")
        found[f"{file}.casadi"] = worst
    for file, function in functions.items():
        text = casadi.StringSerializer()
        text.pack(function)
        write_text(Path(folder) / f"{file}.casadi", text.encode())  # `save` is silent where the disk is full
    return found


def _of_space(casadi: Any, function: Callable[[Tensor, Tensor], Tensor], sizes: Sequence[int]) -> Any:
    """A function of two vectors that torch computes, such as positions and a step, as one of scalars."""
    graph, (found,) = trace(lambda x, y: [function(x, y)], [torch.zeros(size, dtype=torch.float64) for size in sizes])
    return _function(casadi, "moved", graph, found.tolist(), sizes)


def _stepped(casadi: Any, code: Programs, acceleration: Any, x: Sequence[Any], dt: float, integrator: str) -> list[Any]:
    """The steps of `integration.integrators`; Newton's method of the implicit one is CasADi's."""
    (q, v, u), space = x, code.space
    if integrator != "implicit-midpoint":
        method: Any = integrator_named(integrator, code.physics.model)
        if not space.is_vector_space:
            nq, nv, _ = code.sizes
            made = {"integrate": (nq, nv), "chart_velocity": (nv, nv)}
            own = {name: _of_space(casadi, getattr(space, name), sizes) for name, sizes in made.items()}
            method = partial(INTEGRATORS[integrator], SimpleNamespace(**own))
        moved = method(lambda q, v: acceleration(q, v, u), q, v, dt)
        return [moved.q, moved.v]
    middle, half = casadi.MX.sym("middle", v.numel()), 0.5 * dt
    rest = middle - v - half * acceleration(q + half * middle, middle, u)
    solve = casadi.rootfinder("solve", "newton", {"x": middle, "p": casadi.vertcat(q, v, u), "g": rest})
    middle = solve(v, casadi.vertcat(q, v, u))
    return [q + dt * middle, 2.0 * middle - v]


def _function(casadi: Any, name: str, graph: Graph, nodes: Sequence[int], sizes: Sequence[int]) -> Any:
    """Nodes of a graph as a function, by scalars, of vectors of these sizes, which together are its inputs."""
    vectors = [casadi.SX.sym(f"x{number}", size) for number, size in enumerate(sizes)]
    scalars = [entry for vector in vectors for entry in casadi.vertsplit(vector)]
    return casadi.Function(name, vectors, [casadi.vertcat(*expressed(casadi, graph, nodes, scalars))])


def _latents(casadi: Any, code: Programs, x: Sequence[Any]) -> list[Any]:
    graph, found, at = Graph(sum(code.sizes)), {}, code.traced
    copied = Copier(graph, at.graph, dict(zip(at.graph.inputs, graph.inputs, strict=False)))
    for part in code.sums:
        given = KernelSum.given(part, graph, copied(at.features[part.latents[0]]))  # sums also of functions in pieces
        z = _function(casadi, "operands", graph, given, code.sizes)(*x)
        found |= dict(zip(part.latents, _sum(casadi, part, casadi.vertsplit(z)), strict=True))
    return [found[c] for c in sorted(found)]


def _sum(casadi: Any, part: KernelSum, z: Sequence[Any]) -> list[Any]:
    """sum_j w_cj k_c(z, z_j), all centres in one row."""
    known: dict[int, Any] = dict(zip(part.operands, z, strict=True))
    known |= {node: casadi.DM(row).T for node, row in zip(part.rows, part.row_values(), strict=True)}
    kernels = expressed(casadi, part.pair, list(part.kernels), [], known)
    rows = [casadi.MX(k) for k in kernels]  # one number where a kernel is the same for all centres
    return [
        (k * math.fsum(weights.tolist()) if k.is_scalar() else casadi.mtimes(k, casadi.DM(weights.tolist()))) + constant
        for k, weights, constant in zip(rows, part.weights, part.constants, strict=True)
    ]


def expressed(
    casadi: Any, graph: Graph, nodes: Sequence[int], inputs: Sequence[Any], known: dict[int, Any] | None = None
) -> list[Any]:
    """Nodes of a graph without calls as CasADi expressions; `known` are those that are there already."""

    def looked_up(table: Sequence[float], place: Any) -> Any:
        value = table[0]
        for number, entry in enumerate(table[1:], 1):
            value = casadi.if_else(place >= number, entry, value)
        return value

    special = {**ARITHMETIC, **COMPARED, "negate": operator.neg, "absolute": casadi.fabs}
    special |= {"choose": casadi.if_else, "look up": looked_up}
    functions = {name: getattr(casadi, name) for name in FUNCTIONS if name not in special}
    return interpreted(graph, nodes, inputs, functions | special, known)
