"""Minimise an objective over named tensors: L-BFGS, rollback and a named cause."""

import operator
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.optimize import OptimizeResult, minimize
from torch import Tensor

from forcegp.errors import FitError, InvalidInput, NumericalError, NumericalWarning, usable_arguments
from forcegp.progress import tell

Objective = Callable[[Mapping[str, Tensor]], Tensor]

LINE_SEARCH_FAILED = 2  # scipy's L-BFGS-B: neither converged (0) nor stopped by a limit (1)

HALTED = 99  # the status that scipy gives where its callback ended the search

GRADIENT, MEMORY = 1e-4, 200
"""Largest gradient entry at which a search has converged, and iterations that make up the curvature."""

SLOW_ITERATIONS = 5  # iterations over which the progress of a search is judged

SOME_FAILURES = 10
"""A line search that strays now and then meets this many points without a value at most; more of them are a wall."""


@dataclass(frozen=True)
class OptimizerOptions:
    """How to search.

    `iterations`: most of L-BFGS; `tolerance`: of the objective, per iteration; `slow`: stop when `SLOW_ITERATIONS`
    together lower it by less than this (nats); `patience`: stop when so many iterations at the present pace would not
    reach the best of earlier starts, 0 for never.
    """

    iterations: int = 200
    tolerance: float = 1e-8
    slow: float = 0.0
    patience: int = 0

    @usable_arguments("OptimizerOptions")
    def __post_init__(self) -> None:
        if min(operator.index(self.iterations), operator.index(self.patience)) < 0:
            raise InvalidInput(f"iterations={self.iterations} and patience={self.patience} must be >= 0")
        if not (self.tolerance >= 0 and self.slow >= 0):
            raise InvalidInput(f"tolerance={self.tolerance} and slow={self.slow} must be >= 0")


@dataclass(frozen=True)
class OptimizationResult:
    """The best parameters seen, the objective there, its value after every iteration, and why the search ended."""

    parameters: dict[str, Tensor]
    value: float
    history: tuple[float, ...]
    status: str
    converged: bool
    evaluations: int
    cpu_seconds: float


class _Search:
    """Counts evaluations and remembers the best finite one, so that every failure can retreat to it."""

    def __init__(self, objective: Objective, initial: Mapping[str, Tensor]) -> None:
        self.objective = objective
        self.template = {name: value.detach().clone() for name, value in initial.items()}
        self.evaluations = 0
        self.failures = 0
        self.best_value = np.inf
        self.best_point = self.flatten(self.template)
        self.best_slope = np.zeros_like(self.best_point)
        self.cause: str | None = None

    def flatten(self, parameters: Mapping[str, Tensor]) -> np.ndarray:
        values = [parameters[name].detach().reshape(-1) for name in self.template]
        return torch.cat(values).cpu().numpy() if values else np.zeros(0)  # one copy from a GPU, not one each

    def unflatten(self, point: np.ndarray) -> dict[str, Tensor]:
        if not self.template:
            return {}
        device = next(iter(self.template.values())).device
        chunks = torch.tensor(point, device=device).split([value.numel() for value in self.template.values()])
        shaped = zip(self.template.items(), chunks, strict=True)
        return {name: chunk.reshape(value.shape).to(value.dtype, copy=True) for (name, value), chunk in shaped}

    def evaluate(self, point: np.ndarray) -> tuple[float, np.ndarray] | None:
        """Objective and gradient; None, with the cause kept, where they cannot be evaluated or are not finite."""
        self.evaluations += 1
        parameters = {name: value.requires_grad_() for name, value in self.unflatten(point).items()}
        slopes = {name: torch.zeros_like(parameter) for name, parameter in parameters.items()}
        try:
            # Trial points far out may need jitter; whether the result does, shows in the factorisation at the end.
            with torch.enable_grad(), warnings.catch_warnings():
                warnings.simplefilter("ignore", NumericalWarning)
                value = self.objective(parameters)
            if parameters and value.requires_grad:
                found = torch.autograd.grad(value, list(parameters.values()), materialize_grads=True)
                slopes = dict(zip(parameters, found, strict=True))
        except (NumericalError, torch.linalg.LinAlgError) as error:
            return self._fail(str(error))
        number, slope = float(value.detach()), self.flatten(slopes)
        if not (np.isfinite(number) and np.isfinite(slope).all()):
            return self._fail("the objective or its gradient is not finite")
        if number < self.best_value:
            self.best_value, self.best_point, self.best_slope = number, point.copy(), slope
        return number, slope

    def _fail(self, cause: str) -> None:
        self.failures += 1
        self.cause = cause

    def __call__(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Objective and gradient; where there are none, a parabola about the best point, as steep as that falls."""
        if (evaluated := self.evaluate(point)) is not None:
            return evaluated
        step = point - self.best_point
        rise = max(abs(float(self.best_slope @ step)), np.finfo(np.float64).eps * max(1.0, abs(self.best_value)))
        return self.best_value + rise, 2.0 * rise * step / max(float(step @ step), np.finfo(np.float64).tiny)


def minimize_objective(
    objective: Objective, initial: Mapping[str, Tensor], options: OptimizerOptions | None = None, rival: float = np.inf
) -> OptimizationResult:
    """Minimise `objective(parameters)` from `initial` (unconstrained float64 tensors, not changed) by L-BFGS-B.

    A search that finds no step rolls back to the best point and starts again with an empty memory, twice at most.
    `rival` is the best value of earlier starts. Raises FitError where the objective cannot be evaluated at the start.
    """
    options, start_time, search = options or OptimizerOptions(), time.process_time(), _Search(objective, initial)
    if search.evaluate(search.best_point) is None:
        raise FitError(f"the marginal likelihood cannot be evaluated at the start values: {search.cause}")
    history = [search.best_value]

    def after_iteration(intermediate_result: OptimizeResult) -> None:
        history.append(float(intermediate_result.fun))
        value = f"{history[-1]:.1f}" if abs(history[-1]) >= 10.0 else f"{history[-1]:.3g}"
        note = f"iteration {len(history) - 1}, objective {value}"
        tell(min(len(history) - 1, options.iterations), options.iterations, note)
        hopeless = options.patience and SLOW_ITERATIONS * (history[-1] - rival) > options.patience * pace()
        if len(history) > SLOW_ITERATIONS and (pace() < options.slow or hopeless):
            raise StopIteration  # ends the search at this point

    def pace() -> float:
        return history[-1 - SLOW_ITERATIONS :][0] - history[-1]

    converged = not search.best_point.size
    status = "no parameters to search for" if converged else "no iterations asked for"
    remaining = options.iterations
    for _attempt in range(3):
        if remaining <= 0 or not search.best_point.size:
            break
        failures_before = search.failures
        ends = {"maxiter": remaining, "maxfun": 4 * remaining, "ftol": options.tolerance, "gtol": GRADIENT}
        how: Any = ends | {"maxcor": MEMORY}
        result = minimize(search, search.best_point, jac=True, method="L-BFGS-B", callback=after_iteration, options=how)
        remaining -= int(result.nit)
        converged = bool(result.success) or result.status == HALTED
        status = _sentence(int(result.status), str(result.message), options)
        if result.status == HALTED and pace() >= options.slow:
            converged = False
            status = f"dropped: {options.patience} iterations at its pace would not reach the best of earlier starts"
        steep = bool(np.abs(search.best_slope).max() > GRADIENT)
        if result.status == LINE_SEARCH_FAILED and search.failures > failures_before:
            status = "rolled back to the best point: no step from there could be evaluated and lowered the objective"
        elif converged and steep and search.failures > failures_before + SOME_FAILURES:
            # Steps that shrink before a region without values look like convergence to the line search.
            converged, status = False, "stopped beside parameters at which the objective cannot be evaluated"
        if result.status != LINE_SEARCH_FAILED or result.nit == 0:
            break  # a line search that fails at once, with an empty memory, has nothing left to try
    if search.failures:
        status += f" ({search.failures} of {search.evaluations} evaluations failed, the last because {search.cause})"
    found, spent = search.unflatten(search.best_point), time.process_time() - start_time
    value = float(search.best_value)
    return OptimizationResult(found, value, tuple(history), status, converged, search.evaluations, spent)


def _sentence(status: int, message: str, options: OptimizerOptions) -> str:
    """The message of scipy's L-BFGS-B, in words that name what to do."""
    if status == 0 and "GRADIENT" in message:
        return f"converged: the largest gradient entry is below {GRADIENT:g}"
    if status == 0:
        return f"converged: an iteration lowers the objective by less than {options.tolerance:g} of it"
    if status == HALTED:
        return f"converged: {SLOW_ITERATIONS} iterations lower the objective by less than {options.slow:g} nats"
    if status == LINE_SEARCH_FAILED:
        return "stopped where no step lowers the objective, as far as rounding lets it be seen"
    return f"stopped at the limit of {options.iterations} iterations; raise `iterations` to search on"


def best_of(results: list[OptimizationResult]) -> OptimizationResult:
    """The result with the lowest final value; its status holds how many searches it was chosen from."""
    chosen = min(results, key=lambda result: result.value)
    dropped = sum(result.status.startswith("dropped") for result in results)
    note = f"best of {len(results)} starts" + (f", {dropped} of them dropped" if dropped else "")
    return replace(chosen, status=f"{chosen.status} ({note})") if len(results) > 1 else chosen
