"""The search of every fit: what it is given, what it lowers, and several seeded starts, of which the best is kept."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from gpytorch.kernels import ScaleKernel
from jaxtyping import Float
from torch import Tensor

from forcegp.data import Dataset
from forcegp.errors import DataWarning, FitError, InvalidInput, require_type, usable_arguments
from forcegp.evidence.evidence import WindowedRows
from forcegp.forces.basic_kernels import register_log_normal_prior
from forcegp.inference import LatentKernels, OptimizationResult, OptimizerOptions, best_of, minimize_objective
from forcegp.inference.memory import blas_threads
from forcegp.noise import Noise
from forcegp.parallel import Jobs, mapped
from forcegp.robots.arguments import whole_number

MOST_RESTARTS = 10_000
"""So that a slip such as 10**9 is refused: a start takes from tenths of a second to minutes."""


START_SHARE = 0.1
"""Noise of an acceleration over its spread, from which it is learned; its hyperprior spans a factor of e about that."""

QUIET = 1e-3
"""Spread of a joint that hardly moves, as a fraction of the largest."""


def noise_of_windows(noise: Noise | None, windows: WindowedRows) -> Noise | None:
    """The noise given; for None, learned from where the sensors put it.

    That of the sensors is the least that windows can have: states at nodes are not exact either. Raises InvalidInput
    for a torque sensor whose noise predictions shall count: windows give the noise of a mean torque.
    """
    if noise is not None and noise.measured_torque:
        raise InvalidInput(
            "Noise(measured_torque=True) needs the noise of single torques, but windows give that of "
            "their mean; leave measured_torque out, or fit to accelerations"
        )
    if noise is not None or windows.noise_level is None:
        return noise
    return Noise(tuple(float(std) for std in windows.noise_level), learn=True)


def resolved_noise(noise: Noise | None, rows: Dataset | WindowedRows) -> Noise:
    """The noise given, else the level that the training rows state, else one that is learned, with a warning.

    It is then learned from `START_SHARE` of the spread of every joint's acceleration; with `Noise(None, learn=True)`
    nothing is warned of.
    """
    if noise is not None and noise.acceleration is not None:
        return noise
    level = rows.noise_level
    noise = noise or Noise()
    if level is not None:
        return replace(noise, acceleration=tuple(float(std) for std in level))
    if not noise.learn:
        warnings.warn(
            "the dataset does not state the noise of its accelerations, so it is learned with the other parameters; "
            "give `noise` if it is known",
            DataWarning,
            stacklevel=2,
        )
    spread = (rows.observed if isinstance(rows, WindowedRows) else rows.a).std(axis=0)
    largest = float(spread.max())
    if not largest > 0.0:
        raise InvalidInput("the acceleration of every joint is constant, so its noise cannot be learned; give `noise`")
    start = tuple(float(START_SHARE * max(std, QUIET * largest)) for std in spread)
    return replace(noise, acceleration=start, learn=True)


def learns_noise(noise: Noise | None, rows: Dataset) -> bool:
    """Whether `resolved_noise` is one that is learned."""
    if noise is None or noise.acceleration is None:
        return rows.noise_level is None or (noise is not None and noise.learn)
    return noise.learn


def check_search_numbers(restarts: int, seed: int) -> None:
    """Raises InvalidInput for numbers that are out of range."""
    whole_number("restarts", restarts, 1, MOST_RESTARTS, "the most that one search runs")
    whole_number("seed", seed, 0)


@usable_arguments("start")
def first_start(
    moments: Mapping[str, Tensor], given: Mapping[str, Tensor], fixed: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """The moments, with what the caller gives in their place. Raises InvalidInput for what the model does not have."""
    first = dict(moments)
    for name, value in given.items():
        if name in fixed:
            continue  # the noise that this fit holds fixed
        if name not in first:
            raise InvalidInput(f"start has {name!r}; the parameters of this model are {', '.join(sorted(first))}")
        if value.shape != first[name].shape or not bool(torch.isfinite(value).all()):
            raise InvalidInput(
                f"start[{name!r}] has shape {tuple(value.shape)} or is not finite; give {tuple(first[name].shape)}"
            )
        first[name] = value.detach().to(first[name])
    return first


def described_rows(rows: Dataset | WindowedRows, dataset: Dataset) -> dict[str, Any]:
    """What the settings of a fit hold about its training rows and where they come from, as plain JSON values."""
    return {
        "points": len(rows),
        "rows_available": len(dataset),
        "data": {"metadata": dict(dataset.metadata), "episodes": list(dataset.episodes)},
    }


RESTART_SPREAD = 0.7
"""Standard deviation of the random factors (natural log) on the start values of restarts from 1 on."""

SMOOTHER = 4.0
"""Factor on the length scales of odd restarts: on one seed of the benchmark, without a mean, starts around the moments
ended at an error of .1266, the smoother one at .109."""

MOST_POINTS_FOR_RESTARTS = 400
"""Training points up to which several starts are the default."""

FitProgress = Callable[[int, int, float], None]
"""Called as progress(restart, iteration, objective), and with restart `ALL_ROWS` while an engine takes in all rows."""

ALL_ROWS = -1
"""Instead of a restart: the value is then the bound on all rows."""

Outcome = TypeVar("Outcome")


AT_ONCE = 2
"""Starts at once, behind which later ones are dropped: one poor one costs 22 nats (docs/explanation/solvers.md)."""

SMALL = OptimizerOptions(slow=0.02, patience=100)
"""The search on so few rows: to hundredths of a nat, which no prediction shows."""

LARGE = OptimizerOptions(tolerance=1e-6, slow=3.0)
"""On more rows, where an evaluation takes seconds, and three nats of hundreds change nothing that is predicted."""


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
        if not name.startswith("kernels."):  # as in `LatentKernels.initial_parameters`
            shifted[name] = value
            continue
        shift = next((shift for part, shift in shifts.items() if name.endswith(part)), 0.0)
        factors = torch.as_tensor(generator.standard_normal(tuple(value.shape)), device=value.device)
        shifted[name] = value + shift + RESTART_SPREAD * factors
    return shifted


def run_restarts(
    search: Callable[..., Outcome], restarts: int, patience: int, jobs: Jobs, progress: FitProgress | None
) -> Sequence[Outcome]:
    """`search(index, before=outcomes, progress=progress)` from 0 on, so many at once, on which outcomes do not depend.

    Those before are given with `patience` only, and then `AT_ONCE` run at once. Only this process can report progress.
    A single search needs no other process of this machine.
    """
    outcomes: list[Outcome] = []
    while len(outcomes) < restarts:
        last = min(restarts, len(outcomes) + AT_ONCE) if patience else restarts
        indices, before = range(len(outcomes), last), tuple(outcomes)
        if jobs == 1 or (restarts == 1 and isinstance(jobs, int)):
            outcomes += [search(index, before=before, progress=progress) for index in indices]
        else:
            outcomes += mapped(partial(search, before=before, progress=None), indices, jobs)
    return outcomes


def best_value(found: Sequence[OptimizationResult | FitError]) -> float:
    """The lowest objective that was found; infinite where there is none."""
    return min((each.value for each in found if isinstance(each, OptimizationResult)), default=math.inf)


LOG_VARIANCE_SPREAD = 2.0
"""Standard deviation of the prior on the logarithm of a latent's variance, where physical parameters are learned."""


Starts = Callable[[int], Mapping[str, Tensor]]
"""Number of a start -> the parameters at which it begins."""


@dataclass(frozen=True, eq=False)
class FitObjective:
    """The objective as a function of the free hyper-parameters alone; a class so that processes can receive it.

    Kernels (see also `with_variance_priors`) and learned noise have their priors. With inducing
    `points` the bound through them stands for the likelihood.
    """

    likelihood: Any  # a MarginalLikelihood, or one of another model: (kernels, parameters) -> nats, with its `training`
    kernels: LatentKernels
    noise: Noise
    fixed: Mapping[str, Tensor]
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
        """Log density of the hyper-parameters' priors."""
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
    options: OptimizerOptions | None
    start: Mapping[str, Tensor] | None
    progress: FitProgress | None

    @usable_arguments("fit")
    def __post_init__(self) -> None:
        check_search_numbers(1 if self.restarts is None else self.restarts, self.seed)
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
