"""Several seeded starts of one search: what every model that is fitted by marginal likelihood shares."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from forcegp.errors import FitError, NumericalError, NumericalWarning
from forcegp.inference import OptimizationResult, OptimizerOptions
from forcegp.parallel import Backend, Joblib, Serial

RESTART_SPREAD = 0.7
"""Standard deviation of the random factors (natural log) on the start values of restarts 1, 2, ...; restart 0 has
none.
"""

SMOOTHER = 4.0
"""Factor on the length scales of odd restarts. On one seed of the benchmark, without a mean, one start and three
restarts around the moments all ended at an error of .1266, the smoother start at .109.
"""

MOST_POINTS_FOR_RESTARTS = 400
"""Training points up to which several starts are the default."""

KERNELS = "kernels."
"""How the names of kernel parameters begin (`LatentKernels.initial_parameters`)."""

SMALL_COVARIANCE = 2000
"""Rows of the full covariance below which one thread is faster than several (measured on 2 cores)."""

FitProgress = Callable[[int, int, float], None]
"""Called as progress(restart, iteration, objective), and with restart `ALL_ROWS` while an engine takes in all rows."""

ALL_ROWS = -1
"""Instead of a restart: the value is then the relative residual of conjugate gradients, or the bound on all rows."""

Objective = Callable[[Mapping[str, Tensor]], Tensor]

Outcome = TypeVar("Outcome")


AT_ONCE = 2
"""Starts that run at once where later ones are dropped that fall behind. Behind a single poor one, others were dropped
that end 22 nats lower (docs/solvers.md).
"""

SMALL = OptimizerOptions(slow=0.02, patience=100)
"""The search on so few rows: to hundredths of a nat, which no prediction shows."""

LARGE = OptimizerOptions(tolerance=1e-6, slow=3.0)
"""The search on more rows than that, where an evaluation takes seconds, and three nats of hundreds over several
iterations change nothing that is predicted.
"""


def default_options(points: int) -> OptimizerOptions:
    """The search where none is given."""
    return LARGE if points > MOST_POINTS_FOR_RESTARTS else SMALL


def default_restarts(points: int) -> int:
    """Starts of the search where none are asked for."""
    return 4 if points <= MOST_POINTS_FOR_RESTARTS else 1


def perturbed(start: Mapping[str, Tensor], seed: int, index: int) -> dict[str, Tensor]:
    """Kernel parameters shifted by seeded normal numbers on their log scale; noise and physical parameters keep theirs.

    Odd restarts begin near a linear function, at a multiple of the length scales and its square of the variance.
    """
    generator = np.random.default_rng((seed, index))
    shifts = {"lengthscale": math.log(SMOOTHER), "outputscale": 2.0 * math.log(SMOOTHER)} if index % 2 else {}
    shifted = {}
    for name, value in start.items():
        if not name.startswith(KERNELS):
            shifted[name] = value
            continue
        shift = next((shift for part, shift in shifts.items() if name.endswith(part)), 0.0)
        factors = torch.as_tensor(generator.standard_normal(tuple(value.shape)), device=value.device)
        shifted[name] = value + shift + RESTART_SPREAD * factors
    return shifted


def blas_threads(covariance_rows: int) -> AbstractContextManager[Any]:
    """One BLAS thread while the covariance is small: threads that wait for each other cost up to 10 times as much."""
    return threadpool_limits(1) if covariance_rows <= SMALL_COVARIANCE else nullcontext()


def run_restarts(
    search: Callable[..., Outcome], restarts: int, patience: int, backend: Backend, progress: FitProgress | None
) -> Sequence[Outcome]:
    """`search(index, before=outcomes, progress=progress)` from 0 on, on a backend, on which outcomes do not depend.

    Those before are given with `patience` only, and then `AT_ONCE` run at once. Only this process can report progress.
    A single search needs no other process of this machine.
    """
    outcomes: list[Outcome] = []
    while len(outcomes) < restarts:
        last = min(restarts, len(outcomes) + AT_ONCE) if patience else restarts
        indices, before = range(len(outcomes), last), tuple(outcomes)
        if isinstance(backend, Serial) or (restarts == 1 and isinstance(backend, Joblib)):
            outcomes += [search(index, before=before, progress=progress) for index in indices]
        else:
            outcomes += backend.map(partial(search, before=before, progress=None), indices)
    return outcomes


def best_value(found: Sequence[OptimizationResult | FitError]) -> float:
    """The lowest objective that was found; infinite where there is none."""
    return min((each.value for each in found if isinstance(each, OptimizationResult)), default=math.inf)


def with_steps_before(
    result: OptimizationResult, objective: Objective, before: Sequence[dict[str, Tensor]]
) -> OptimizationResult:
    """The result with the steps before the search in front; a step without a finite objective must not cost the fit."""
    kept: list[tuple[float, dict[str, Tensor]]] = []
    for point in before:
        try:
            with torch.no_grad():
                value = float(objective(point))
        except (NumericalError, torch.linalg.LinAlgError):
            value = math.nan
        if math.isfinite(value):
            kept.append((value, point))
    if len(kept) < len(before):
        warnings.warn(
            f"the objective cannot be evaluated at {len(before) - len(kept)} of {len(before)} steps before the search; "
            "the history begins later, the estimates do not depend on it",
            NumericalWarning,
            stacklevel=3,
        )
    return replace(
        result,
        history=(*(value for value, _ in kept), *result.history),
        iterates=(*(point for _, point in kept), *result.iterates),
    )
