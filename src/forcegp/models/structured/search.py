"""The search of a structured model: several starts, of which the best is kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from torch import Tensor

from forcegp.errors import FitError, InvalidInput, require_type, usable_arguments
from forcegp.inference import OptimizationResult, OptimizerOptions, best_of, minimize_objective
from forcegp.models.fit_arguments import check_search_numbers, first_start
from forcegp.models.identification.physical_parameters import PHYSICAL
from forcegp.models.search import (
    SMALL,
    FitProgress,
    best_value,
    blas_threads,
    default_options,
    default_restarts,
    perturbed,
    run_restarts,
)
from forcegp.models.structured.objective import FitObjective
from forcegp.parallel import Backend


@dataclass(frozen=True, eq=False)
class Search:
    """How a fit searches: what the three ways to fit share. The fields are documented at `StructuredGP.fit`.

    Raises InvalidInput for numbers out of range and a start in units of another fit.
    """

    backend: Backend
    restarts: int | None
    seed: int
    hyperprior: bool
    options: OptimizerOptions | None
    start: Mapping[str, Tensor] | None
    progress: FitProgress | None

    @usable_arguments("fit")
    def __post_init__(self) -> None:
        check_search_numbers(1 if self.restarts is None else self.restarts, self.seed)
        require_type("hyperprior", self.hyperprior, bool)
        if self.options is not None:
            require_type("options", self.options, OptimizerOptions)
        if PHYSICAL in (self.start or {}):
            raise InvalidInput(
                f"start has {PHYSICAL!r}, numbers in units that the data of their own fit gave them; leave it out, and "
                "give the model the system whose values the search shall start from, as in "
                "StructuredGP(posterior.system)"
            )

    def resolved(self, rows: int) -> tuple[int, OptimizerOptions]:
        """Restarts and options for so many rows."""
        restarts = default_restarts(rows) if self.restarts is None else self.restarts
        return restarts, self.options or default_options(rows)

    def best(
        self, objective: FitObjective, moments: Mapping[str, Tensor], keep_iterates: bool = False
    ) -> tuple[OptimizationResult, dict[str, Any]]:
        """The best of all starts with the work of all, and the settings of the search as plain JSON values.

        The first start is `moments`, with what `start` gives in their place. Raises FitError where none could be
        evaluated.
        """
        restarts, options = self.resolved(len(objective.likelihood.training))
        if objective.physical is not None and options is SMALL:
            options = OptimizerOptions()  # standard errors are those of the optimum itself
        first = first_start(moments, self.start or {}, objective.fixed)
        kept = replace(options, keep_iterates=True) if keep_iterates else options
        one = _OneStart(objective, moments, first, self.seed, kept)
        with blas_threads(objective.likelihood.training.q.numel()):
            results = run_restarts(one, restarts, options.patience, self.backend, self.progress)
        usable = [result for result in results if isinstance(result, OptimizationResult)]
        if not usable:
            causes = "; ".join(f"restart {k}: {error}" for k, error in enumerate(results))
            raise FitError(f"none of {restarts} restarts could be evaluated ({causes})")
        best = replace(
            best_of(usable),
            evaluations=sum(search.evaluations for search in usable),
            cpu_seconds=sum(search.cpu_seconds for search in usable),
        )
        settings = {
            "restarts": restarts,
            "warm_start": self.start is not None,
            "seed": self.seed,
            "optimizer": asdict(options),
            "hyperprior": self.hyperprior,
            "restart_objective": [each.value if isinstance(each, OptimizationResult) else None for each in results],
            "restart_status": [each.status if isinstance(each, OptimizationResult) else str(each) for each in results],
        }
        return best, settings


@dataclass(frozen=True, eq=False)
class _OneStart:
    """The optimisation from start number `index`: 0 begins at `first`, the others around the moments.

    A class so that other processes can receive it.
    """

    objective: FitObjective
    moments: Mapping[str, Tensor]
    first: Mapping[str, Tensor]
    seed: int
    options: OptimizerOptions

    def __call__(
        self, index: int, before: Sequence[OptimizationResult | FitError], progress: FitProgress | None
    ) -> OptimizationResult | FitError:
        """Where it ended, or why it could not begin."""
        first = perturbed(self.moments, self.seed, index) if index else self.first
        note = None if progress is None else (lambda iteration, value: progress(index, iteration, value))
        try:
            return minimize_objective(self.objective, first, self.options, note, best_value(before))
        except FitError as error:
            return error
