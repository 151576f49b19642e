"""Motions by a compiled loop: several in the lanes of vector registers, no Python per step, several threads.

A step calls the C program of the acceleration (`predictor_code`). The implicit step is Newton's method with its exact
Jacobian, shortened where it overshoots. A motion that the loop cannot carry to the end, because it diverges, because
Newton's method fails, or because it leaves the range of a table, is left to `integration`, which decides what it is.
"""

import ctypes
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from forcegp.codegen.c_text import c_text, filled, sections
from forcegp.codegen.c_writer import ROWS
from forcegp.codegen.library import in_threads
from forcegp.errors import InvalidInput, NumericalWarning
from forcegp.integration.integrators import Integrator, check_time_step, integrator_named
from forcegp.integration.trajectory import SPEED_LIMIT, Trajectory, check_start, integrate, warn_of_divergence
from forcegp.model import Model
from forcegp.robots.manifold import ConfigurationSpace

STEPS = sections(__name__, "rollout_steps.c")
"""One step in C: from x = [q, v, u] to q1, v1, with the acceleration a at its beginning."""


ON_A_MANIFOLD = "-on-a-manifold"


def step_source(method: str, function: str, space: ConfigurationSpace, sizes: tuple[int, int, int]) -> str:
    """The text of a step that calls `function`, whose slopes are those in a step from q, v and u."""
    return filled(steps_of(space)[method], {"PROGRAM": function, "COLUMNS": 2 * sizes[1] + sizes[2]})


def steps_of(space: ConfigurationSpace) -> dict[str, str]:
    """The steps in C, by integrator, of a robot with these positions."""
    apart = {name: text for name, text in STEPS.items() if name.endswith(ON_A_MANIFOLD) != space.is_vector_space}
    return {name.removesuffix(ON_A_MANIFOLD): text for name, text in apart.items()}


def require_step(seconds: object, integrator: str, model: Model) -> None:
    """Raise InvalidInput for anything but a positive number of seconds, and an integrator that has no step in C."""
    check_time_step(seconds)
    integrator_named(integrator, model)
    there = steps_of(model.robot.space)
    if integrator not in there:
        raise InvalidInput(
            f"an exported step is not {integrator!r}; give one of {', '.join(map(repr, there))} as `integrator`."
        )


def loop_source(method: str, function: str, space: ConfigurationSpace, sizes: tuple[int, int, int]) -> str:
    """The C function `evaluate` of a loop whose steps call `function`, which for implicit ones gives slopes, too."""
    nq, nv, nu = sizes
    outputs = nv + nv * (2 * nv + nu) if method == "implicit-midpoint" else nv
    words = {"JOINTS": nv, "POSITIONS": nq, "GIVEN": nu, "OUTPUTS": outputs, "LIMIT": SPEED_LIMIT}
    words |= {"STEP": step_source(method, function, space, sizes)}
    return ROWS + filled(c_text(__name__, "rollout_loop.c"), words)


def fused(
    loops: "Sequence[FusedLoop]",
    method: Integrator,
    acceleration: Callable[[Tensor, Tensor, Tensor], Tensor],
    q: Float[Tensor, "n nq"],
    v: Float[Tensor, "n nv"],
    u: Float[Tensor, "steps n nu"],
    dt: float,
    threads: int,
    what: str = "motions",
) -> Trajectory:
    """`integrate`, by compiled loops; each takes as many motions as the others, one after the other.

    Motions that a loop could not finish are integrated again, with those of the other loops from the same place.
    """
    check_start(v, dt)
    own, count, forces = len(q) // len(loops), len(q), u.movedim(0, 1)
    places = [slice(own * k, own * (k + 1)) for k in range(len(loops))]
    parts = [loop(q[at], v[at], forces[at], dt, threads) for loop, at in zip(loops, places, strict=True)]
    Q, V, A, ended = parts[0] if len(parts) == 1 else map(torch.cat, zip(*parts, strict=True))
    not_found = torch.zeros(count, dtype=torch.bool)
    left = torch.nonzero((ended < -1).view(-1, own).any(0))[:, 0]
    if len(left):
        rows = (own * torch.arange(len(loops))[:, None] + left).flatten()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)  # given below, of all motions
            again = integrate(method, acceleration, q[rows], v[rows], u[:, rows], dt)
        for kept, found in ((Q, again.q), (V, again.v), (A, again.a)):
            kept[rows] = found.movedim(0, 1)
        ended[rows], not_found[rows] = again.diverged_at, again.not_found
    warn_of_divergence(ended, not_found, method.failure, dt, what)
    return Trajectory(Q.movedim(1, 0), V.movedim(1, 0), A.movedim(1, 0), ended, not_found)


class Motions(NamedTuple):
    """q, v (..., T+1, nv) in rad and rad/s (m and m/s), a (..., T, nv) in rad/s^2 (m/s^2), as in a `Rollout`.

    `diverged_at` (...) is the row from which on a motion is NaN because it diverged, -1 if it lasted to the end.
    """

    q: Tensor
    v: Tensor
    a: Tensor
    diverged_at: Tensor


class FusedLoop:
    """`evaluate` of a loaded library; `tables` are those of the functions that it calls."""

    def __init__(self, library: ctypes.CDLL, tables: Sequence[Tensor]) -> None:
        self.library, self._held = library, tuple(tables)
        self._tables = (ctypes.c_void_p * max(len(tables), 1))(*(x.data_ptr() for x in tables))
        self._evaluate = library.evaluate
        self._evaluate.argtypes = (
            [ctypes.c_long] * 2 + [ctypes.c_void_p, ctypes.c_long, ctypes.c_double] + [ctypes.c_void_p] * 7
        )

    def __call__(
        self, q: Tensor, v: Tensor, u: Tensor, dt: float, threads: int
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """q, v (n, T + 1, size), a (n, T, nv) from states (n, size) under u (n, T, nu), and where motions stopped.

        (n,) -1 for those that lasted, the row from which on a motion is NaN for those that became too fast, and -2 less
        that row for those that the loop could not carry on.
        """
        (n, steps, _), nv = u.shape, v.shape[-1]
        Q, V = (torch.empty(n, steps + 1, x.shape[-1], dtype=torch.float64) for x in (q, v))
        A, ended = torch.empty(n, steps, nv, dtype=torch.float64), torch.empty(n, dtype=torch.int64)
        given = [x.contiguous() for x in (q, v, u)]
        pointers = [x.data_ptr() for x in (*given, Q, V, A, ended)]
        parts = max(1, min(threads, n // 8))
        bounds = [8 * (n * k // parts // 8) for k in range(parts)] + [n]

        def part(k: int) -> int:
            return self._evaluate(bounds[k], bounds[k + 1], self._tables, steps, dt, *pointers)

        in_threads(part, parts)
        return Q, V, A, ended
