"""The search of a structured model: several starts, of which the best is kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from torch import Tensor

from forcegp.errors import FitError
from forcegp.inference import OptimizationResult, OptimizerOptions, best_of, minimize_objective
from forcegp.models.objective import FitObjective
from forcegp.models.search import FitProgress, blas_threads, perturbed, run_restarts
from forcegp.parallel import Backend


@dataclass(frozen=True, eq=False)
class StructuredSearch:
    """One optimisation from start number `index`: 0 begins at `first`, the others around the moments."""

    objective: FitObjective
    moments: Mapping[str, Tensor]
    first: Mapping[str, Tensor]
    seed: int
    options: OptimizerOptions

    def __call__(self, index: int, progress: FitProgress | None = None) -> OptimizationResult | FitError:
        """Where it ended, or why it could not begin."""
        first = perturbed(self.moments, self.seed, index) if index else self.first
        note = None if progress is None else (lambda iteration, value: progress(index, iteration, value))
        try:
            return minimize_objective(self.objective, first, self.options, note)
        except FitError as error:
            return error

    def best(
        self, restarts: int, backend: Backend, progress: FitProgress | None
    ) -> tuple[OptimizationResult, list[float | None]]:
        """The best of so many starts with the work of all, and the final value of each (None for those that failed).

        Raises FitError where none could be evaluated.
        """
        with blas_threads(self.objective.likelihood.training.q.numel()):
            results = run_restarts(self, restarts, backend, progress)
        usable = [result for result in results if isinstance(result, OptimizationResult)]
        if not usable:
            causes = "; ".join(f"restart {k}: {error}" for k, error in enumerate(results))
            raise FitError(f"none of {restarts} restarts could be evaluated ({causes})")
        best = replace(
            best_of(usable),
            evaluations=sum(search.evaluations for search in usable),
            cpu_seconds=sum(search.cpu_seconds for search in usable),
        )
        return best, [result.value if isinstance(result, OptimizationResult) else None for result in results]
