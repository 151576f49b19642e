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

from forcegp.errors import FitError, InvalidInput, require_type, usable_arguments
from forcegp.inference import LatentKernels, OptimizationResult, OptimizerOptions, best_of, minimize_objective
from forcegp.models.identification.physical_parameters import PHYSICAL, Learned, PhysicalParameters, inertials_of
from forcegp.models.search import (
    SMALL,
    FitProgress,
    best_value,
    blas_threads,
    check_search_numbers,
    default_options,
    default_restarts,
    first_start,
    perturbed,
    run_restarts,
)
from forcegp.models.training_data import Noise
from forcegp.parallel import Backend
from forcegp.priors.basic_kernels import register_log_normal_prior
from forcegp.robots import pseudo_inertia_from_parameters

LOG_VARIANCE_SPREAD = 2.0
"""Standard deviation of the prior on the logarithm of a latent's variance, where physical parameters are learned."""


Starts = Callable[[int], Mapping[str, Tensor]]
"""Number of a start -> the parameters at which it begins."""


@dataclass(frozen=True, eq=False)
class FitObjective:
    """The objective as a function of the free parameters alone; a class so that processes can receive it.

    With `hyperprior` kernels (see also `with_variance_priors`) and learned noise have their priors; `prior_strength` is
    the weight of the learned inertias' distance from where they start. With inducing `points` the bound through them
    stands for the likelihood.
    """

    likelihood: Any  # a MarginalLikelihood, or one of another model: (kernels, parameters) -> nats, with its `training`
    kernels: LatentKernels
    noise: Noise
    fixed: Mapping[str, Tensor]
    hyperprior: bool
    physical: PhysicalParameters | None = None
    prior_strength: float = 0.0
    points: Sequence[Tensor] | None = None

    def __call__(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """In nats; differentiable once in every parameter."""
        named = {**self.fixed, **parameters}
        penalty = torch.zeros((), dtype=torch.float64)
        if self.physical is not None:
            named |= self.physical.tensors(named.pop(PHYSICAL))
            if self.prior_strength:
                start = inertials_of(self.physical.tensors(self.physical.zero))
                distances = [squared_distance(value, start[link]) for link, value in inertials_of(named).items()]
                penalty = 0.5 * self.prior_strength * sum(distances, penalty)
        if self.points is None:
            value = self.likelihood(self.kernels, named) + penalty
        else:
            value = self.likelihood.bound(self.kernels, named, self.points) + penalty
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


def squared_distance(parameters: Float[Tensor, "10"], reference: Float[Tensor, "10"]) -> Float[Tensor, ""]:
    """Squared affine-invariant distance of two pseudo-inertias P and P0, given as log-Cholesky parameters.

    d^2 = |log(P0^-1/2 P P0^-1/2)|_F^2 = sum_i log^2 lambda_i with the eigenvalues of P0^-1 P (Lee, Wensing & Park,
    "Geometric robot dynamic identification: a convex programming approach", T-RO 2020). It is the same in every frame
    and unit: a body of twice the mass and inertia is 2 log 2 away, wherever it is.
    """
    relative = relative_inertia(parameters, torch.linalg.cholesky(pseudo_inertia_from_parameters(reference)))
    return torch.linalg.eigvalsh(0.5 * (relative + relative.mT)).log().square().sum()


def relative_inertia(parameters: Float[Tensor, "10"], lower: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """L^-1 P L^-T of the pseudo-inertia P of these log-Cholesky parameters."""
    half = torch.linalg.solve_triangular(lower, pseudo_inertia_from_parameters(parameters), upper=False)
    return torch.linalg.solve_triangular(lower, half.mT, upper=False)


@dataclass(frozen=True, eq=False)
class Search:
    """How a fit searches: what the three ways to fit share, documented at `StructuredGP.fit` and `identify`.

    Raises InvalidInput for numbers out of range and a start in units of another fit.
    """

    backend: Backend
    restarts: int | None
    seed: int
    hyperprior: bool
    options: OptimizerOptions | None
    start: Mapping[str, Tensor] | None
    progress: FitProgress | None
    learn: Learned | Sequence[Learned] | None = None
    prior_strength: float = 0.0

    @usable_arguments("fit")
    def __post_init__(self) -> None:
        if not 0.0 <= self.prior_strength < float("inf"):
            raise InvalidInput(f"prior_strength is {self.prior_strength}; it must be finite and at least 0")
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

    def starts(self, moments: Mapping[str, Tensor], fixed: Mapping[str, Tensor]) -> Starts:
        """Start `index`: 0 is the moments, with what `start` gives in their place, others lie around the moments."""
        return partial(_start, moments, first_start(moments, self.start or {}, fixed), self.seed)

    def best(
        self, objective: FitObjective, starts: Starts, keep_iterates: bool = False, what: str = ""
    ) -> tuple[OptimizationResult, dict[str, Any]]:
        """The best of all starts with the work of all, and the settings of the search as plain JSON values.

        Raises FitError where none could be evaluated; `what` follows "evaluated" in its message.
        """
        restarts, options = self.resolved(len(objective.likelihood.training))
        if objective.physical is not None and options is SMALL:
            options = OptimizerOptions()  # standard errors are those of the optimum itself
        kept = replace(options, keep_iterates=keep_iterates or options.keep_iterates)
        one = partial(_one_start, objective, starts, kept)
        with blas_threads(objective.likelihood.training.q.numel()):
            results = run_restarts(one, restarts, options.patience, self.backend, self.progress)
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
