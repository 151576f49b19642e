"""Minimise an objective over a dictionary of named tensors: L-BFGS with an optional Adam warm-up, rollback and a named cause."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from forcegp.errors import FitError, InvalidInput, NumericalError

Objective = Callable[[Mapping[str, Tensor]], Tensor]
ProgressCallback = Callable[[int, float], None]


@dataclass(frozen=True)
class OptimizerOptions:
    """How to search.

    `iterations`: most L-BFGS iterations; `tolerance`: stop when an iteration lowers the objective by less than this fraction of it;
    `gradient_tolerance`: stop when the largest gradient entry is below this; `adam_steps`, `adam_rate`: optional warm-up.
    """

    iterations: int = 200
    tolerance: float = 1e-8
    gradient_tolerance: float = 1e-4
    memory: int = 20
    adam_steps: int = 0
    adam_rate: float = 0.1

    def __post_init__(self) -> None:
        if self.iterations < 0 or self.adam_steps < 0:
            raise InvalidInput(f"iterations={self.iterations} and adam_steps={self.adam_steps} must be >= 0")
        if not (self.tolerance >= 0 and self.gradient_tolerance >= 0 and self.adam_rate > 0 and self.memory > 0):
            raise InvalidInput("tolerances must be >= 0, adam_rate and memory > 0")


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
    """Counts evaluations and remembers the best finite one, so that every failure can roll back to it."""

    def __init__(self, objective: Objective, initial: Mapping[str, Tensor]) -> None:
        self.objective = objective
        self.template = {name: value.detach().clone() for name, value in initial.items()}
        self.evaluations = 0
        self.best_value = np.inf
        self.best_point = self.flatten(self.template)
        self.cause: str | None = None

    def flatten(self, parameters: Mapping[str, Tensor]) -> np.ndarray:
        arrays = [parameters[name].detach().cpu().reshape(-1).numpy() for name in self.template]
        return np.concatenate(arrays) if arrays else np.zeros(0)

    def unflatten(self, point: np.ndarray) -> dict[str, Tensor]:
        parameters, offset = {}, 0
        for name, value in self.template.items():
            chunk = torch.as_tensor(point[offset : offset + value.numel()].copy(), dtype=value.dtype)
            parameters[name] = chunk.reshape(value.shape).to(value.device)
            offset += value.numel()
        return parameters

    def __call__(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Objective and gradient; a point that cannot be evaluated counts as +inf and its cause is kept."""
        self.evaluations += 1
        parameters = {name: value.requires_grad_() for name, value in self.unflatten(point).items()}
        try:
            value = self.objective(parameters)
            gradients = torch.autograd.grad(value, list(parameters.values()), allow_unused=True)
        except (NumericalError, torch.linalg.LinAlgError) as error:
            self.cause = str(error)
            return np.inf, np.zeros_like(point)
        filled = {
            name: torch.zeros_like(parameter) if gradient is None else gradient
            for (name, parameter), gradient in zip(parameters.items(), gradients, strict=True)
        }
        number, slope = float(value.detach()), self.flatten(filled)
        if not (np.isfinite(number) and np.isfinite(slope).all()):
            self.cause = "the objective or its gradient is not finite"
            return np.inf, np.zeros_like(point)
        if number < self.best_value:
            self.best_value, self.best_point = number, point.copy()
        return number, slope


def minimize_objective(
    objective: Objective,
    initial: Mapping[str, Tensor],
    options: OptimizerOptions | None = None,
    progress: ProgressCallback | None = None,
) -> OptimizationResult:
    """Minimise `objective(parameters)` from `initial` (unconstrained float64 tensors, not changed).

    L-BFGS with a strong-Wolfe line search (scipy's L-BFGS-B). A point where the objective cannot be evaluated makes the search
    fall back to the best point seen and start again from there with an empty memory, twice at most; then it ends there and says why.
    `progress(iteration, value)` is called after every iteration.

    Raises
    ------
    FitError
        The objective cannot be evaluated at the start.
    """
    options = options or OptimizerOptions()
    start_time = time.process_time()
    search = _Search(objective, initial)
    first_value, _ = search(search.best_point)
    if not np.isfinite(first_value):
        raise FitError(f"the marginal likelihood cannot be evaluated at the start values: {search.cause}")
    history = [first_value]

    def record(value: float) -> None:
        history.append(value)
        if progress is not None:
            progress(len(history) - 1, value)

    if options.adam_steps:
        _adam(search, options, record)
    status, converged = "no iterations asked for", False
    remaining = options.iterations
    for _attempt in range(3):
        if remaining <= 0 or not search.best_point.size:
            break
        search.cause = None
        result = minimize(
            search,
            search.best_point,
            jac=True,
            method="L-BFGS-B",
            callback=lambda intermediate_result: record(float(intermediate_result.fun)),
            options={
                "maxiter": remaining,
                "maxfun": 4 * remaining,
                "maxcor": options.memory,
                "ftol": options.tolerance,
                "gtol": options.gradient_tolerance,
            },
        )
        remaining -= int(result.nit)
        converged = bool(result.success) and search.cause is None
        status = str(result.message)
        if search.cause is None:
            break
        status = f"rolled back to the best point after: {search.cause}"
    return OptimizationResult(
        parameters=search.unflatten(search.best_point),
        value=float(search.best_value),
        history=tuple(history),
        status=status,
        converged=converged,
        evaluations=search.evaluations,
        cpu_seconds=time.process_time() - start_time,
    )


def _adam(search: _Search, options: OptimizerOptions, record: Callable[[float], None]) -> None:
    """Kingma & Ba (2015), algorithm 1; ends early at the first point that cannot be evaluated."""
    point = torch.as_tensor(search.best_point.copy()).requires_grad_()
    optimizer = torch.optim.Adam([point], lr=options.adam_rate)
    for _ in range(options.adam_steps):
        value, slope = search(point.detach().numpy())
        if not np.isfinite(value):
            return
        point.grad = torch.as_tensor(slope)
        optimizer.step()
        record(value)


def best_of(results: list[OptimizationResult]) -> OptimizationResult:
    """The result with the lowest final value; its status says how many searches it was chosen from."""
    chosen = min(results, key=lambda result: result.value)
    return replace(chosen, status=f"{chosen.status} (best of {len(results)} starts)") if len(results) > 1 else chosen
