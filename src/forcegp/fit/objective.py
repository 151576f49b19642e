"""The search of a structured model: what a fit lowers, and several starts, of which the best is kept."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import torch
from gpytorch.kernels import ScaleKernel
from jaxtyping import Float
from torch import Tensor

from forcegp.errors import FitError, require_type, usable_arguments
from forcegp.fit.search import (
    FitProgress,
    best_value,
    check_search_numbers,
    default_options,
    default_restarts,
    first_start,
    perturbed,
    run_restarts,
)
from forcegp.forces.basic_kernels import register_log_normal_prior
from forcegp.inference import LatentKernels, OptimizationResult, OptimizerOptions, best_of, minimize_objective
from forcegp.inference.threads import blas_threads
from forcegp.noise import Noise
from forcegp.parallel import Jobs

LOG_VARIANCE_SPREAD = 2.0
"""Standard deviation of the prior on the logarithm of a latent's variance, where physical parameters are learned."""


Starts = Callable[[int], Mapping[str, Tensor]]
"""Number of a start -> the parameters at which it begins."""


@dataclass(frozen=True, eq=False)
class FitObjective:
    """The objective as a function of the free hyper-parameters alone; a class so that processes can receive it.

    With `hyperprior` kernels (see also `with_variance_priors`) and learned noise have their priors. With inducing
    `points` the bound through them stands for the likelihood.
    """

    likelihood: Any  # a MarginalLikelihood, or one of another model: (kernels, parameters) -> nats, with its `training`
    kernels: LatentKernels
    noise: Noise
    fixed: Mapping[str, Tensor]
    hyperprior: bool
    points: Sequence[Tensor] | None = None

    def __call__(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """In nats; differentiable once in every parameter."""
        named = {**self.fixed, **parameters}
        if self.points is None:
            value = self.likelihood(self.kernels, named)
        else:
            value = self.likelihood.bound(self.kernels, named, self.points)
        return value - self.log_prior(parameters)

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """Log density of the hyper-parameters' priors; 0 without `hyperprior`."""
        if not self.hyperprior:
            return torch.zeros((), dtype=torch.float64)
        return self.kernels.log_prior(parameters) + self.noise.log_prior(parameters)


def with_variance_priors(kernels: LatentKernels) -> LatentKernels:
    """A copy of which every output scale (variance) carries the prior log variance ~ N(log of its present value, 2^2).

    For fits that learn physical parameters, whose present values come from moments of the residual. The likelihood is
    flat below the noise: there a variance can run off to zero, the curvature takes the force for known to be zero, and
    standard errors of what competes with it are too small. Shared kernels count once; priors that a kernel brought
    along stay.
    """
    out = deepcopy(kernels)
    for module in out.modules():
        if isinstance(module, ScaleKernel) and "outputscale_prior" not in [name for name, *_ in module.named_priors()]:
            register_log_normal_prior(module, "outputscale", torch.as_tensor(module.outputscale), LOG_VARIANCE_SPREAD)
    return out


@dataclass(frozen=True, eq=False)
class Search:
    """How a fit searches for hyper-parameters, documented at `forcegp.fit`.

    Raises InvalidInput for numbers out of range.
    """

    jobs: Jobs
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

    def resolved(self, rows: int) -> tuple[int, OptimizerOptions]:
        """Restarts and options for so many rows."""
        restarts = default_restarts(rows) if self.restarts is None else self.restarts
        return restarts, self.options or default_options(rows)

    def starts(self, moments: Mapping[str, Tensor], fixed: Mapping[str, Tensor]) -> Starts:
        """Start `index`: 0 is the moments, with what `start` gives in their place, others lie around the moments."""
        return partial(_start, moments, first_start(moments, self.start or {}, fixed), self.seed)

    def best(
        self, objective: FitObjective, starts: Starts, what: str = ""
    ) -> tuple[OptimizationResult, dict[str, Any]]:
        """The best of all starts with the work of all, and the settings of the search as plain JSON values.

        Raises FitError where none could be evaluated; `what` follows "evaluated" in its message.
        """
        restarts, options = self.resolved(len(objective.likelihood.training))
        one = partial(_one_start, objective, starts, options)
        with blas_threads(objective.likelihood.training.q.numel()):
            results = run_restarts(one, restarts, options.patience, self.jobs, self.progress)
        usable = [result for result in results if isinstance(result, OptimizationResult)]
        if not usable:
            causes = "; ".join(f"restart {k}: {error}" for k, error in enumerate(results))
            raise FitError(f"none of {restarts} restarts could be evaluated{what} ({causes})")
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


def _start(moments: Mapping[str, Tensor], first: Mapping[str, Tensor], seed: int, index: int) -> Mapping[str, Tensor]:
    return perturbed(moments, seed, index) if index else first


def _one_start(
    objective: FitObjective,
    starts: Starts,
    options: OptimizerOptions,
    index: int,
    before: Sequence[OptimizationResult | FitError],
    progress: FitProgress | None,
) -> OptimizationResult | FitError:
    """Where the search from start `index` ended, or why it could not begin."""
    note = None if progress is None else (lambda iteration, value: progress(index, iteration, value))
    try:
        return minimize_objective(objective, starts(index), options, note, best_value(before))
    except FitError as error:
        return error
