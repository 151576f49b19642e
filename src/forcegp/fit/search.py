"""The search of every fit: several seeded starts, the best is kept; and how much wider intervals have to be."""

import contextlib
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
from scipy.linalg import hadamard
from torch import Tensor

from forcegp import inference
from forcegp.data import Dataset
from forcegp.errors import DataWarning, FitError, InvalidInput, NumericalError, require_type, usable_arguments
from forcegp.forces.kernels import LOG_VARIANCE_SPREAD, register_log_normal_prior
from forcegp.inference.memory import blas_threads
from forcegp.inference.posterior import ExactPosterior
from forcegp.noise import STATED, Noise
from forcegp.parallel import Jobs, mapped
from forcegp.posterior import Posterior
from forcegp.posterior.fitted import DEVIATIONS
from forcegp.progress import part
from forcegp.robots.arguments import whole_number

MOST_RESTARTS = 10_000  # so that a slip such as 10**9 is refused: a start takes from tenths of a second to minutes


START_SHARE = 0.1
"""Noise of an acceleration over its spread, from which it is learned; its hyperprior spans a factor of e about that."""

QUIET = 1e-3  # spread of a joint that hardly moves, as a fraction of the largest


def resolved_noise(noise: Noise | None, rows: Dataset) -> Noise:
    """The noise given, else that of the rows, else one that is learned, with a warning unless `learn` is True."""
    if noise is not None and noise.acceleration is not None:
        return noise
    level, noise = rows.noise_std, noise or Noise()
    if level is not None:
        return replace(noise, acceleration=tuple(float(std) for std in level))
    if not noise.learn:
        warnings.warn(
            "the dataset does not state the noise of its accelerations, so it is learned with the other parameters; "
            "give `noise` if it is known",
            DataWarning,
            stacklevel=2,
        )
    spread = rows.a.std(axis=0)
    largest = float(spread.max())
    if not largest > 0.0:
        raise InvalidInput("the acceleration of every joint is constant, so its noise cannot be learned; give `noise`")
    start = tuple(float(START_SHARE * max(std, QUIET * largest)) for std in spread)
    return replace(noise, acceleration=start, learn=True)


def learns_noise(noise: Noise | None, rows: Dataset) -> bool:
    """Whether `resolved_noise` is one that is learned."""
    if noise is None or noise.acceleration is None:
        return rows.noise_std is None or (noise is not None and noise.learn)
    return noise.learn


@usable_arguments("start")
def first_start(
    moments: Mapping[str, Tensor], given: Mapping[str, Tensor], fixed: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """The moments, with what the caller gives in their place. Raises InvalidInput for what the model does not have."""
    first = dict(moments)
    for name, value in given.items():
        if name in fixed or name in STATED:
            continue  # the noise that this fit holds fixed
        if name not in first:
            raise InvalidInput(f"start has {name!r}; the parameters of this model are {', '.join(sorted(first))}")
        if value.shape != first[name].shape or not bool(torch.isfinite(value).all()):
            raise InvalidInput(
                f"start[{name!r}] has shape {tuple(value.shape)} or is not finite; give {tuple(first[name].shape)}"
            )
        first[name] = value.detach().to(first[name])
    return first


def described_rows(rows: Dataset, dataset: Dataset) -> dict[str, Any]:
    """What the settings of a fit hold about its training rows and where they come from, as plain JSON values."""
    data = {"metadata": dict(dataset.metadata), "episodes": list(dataset.episodes)}
    return {"points": len(rows), "rows_available": len(dataset), "data": data}


RESTART_SPREAD = 0.7  # standard deviation of the random factors (natural log) on the start values of restarts from 1 on

SMOOTHER = 4.0
"""Factor on the length scales of odd restarts: on one seed of the benchmark, without a mean, starts around the moments
ended at an error of .1266, the smoother one at .109."""

MOST_POINTS_FOR_RESTARTS = 400  # training points up to which several starts are the default

Outcome = TypeVar("Outcome")


AT_ONCE = 2
"""Starts at once, behind which later ones are dropped: one poor one costs 22 nats (docs/explanation/solvers.md)."""

SMALL = inference.OptimizerOptions(slow=0.02, patience=100)
"""The search on so few rows: to hundredths of a nat, which no prediction shows."""

LARGE = inference.OptimizerOptions(tolerance=1e-6, slow=3.0)
"""On more rows, where an evaluation takes seconds, and three nats of hundreds change nothing that is predicted."""


def default_options(points: int) -> inference.OptimizerOptions:
    """The search where none is given."""
    return LARGE if points > MOST_POINTS_FOR_RESTARTS else SMALL


def started(moments: Mapping[str, Tensor], first: Mapping[str, Tensor], seed: int, index: int) -> Mapping[str, Tensor]:
    """`first`; of later starts the moments, with kernels shifted by seeded normal numbers on their log scale.

    Odd restarts begin near a linear function, at a multiple of the length scales and its square of the variance.
    """
    if not index:
        return first
    generator = np.random.default_rng((seed, index))
    shifts = {"lengthscale": math.log(SMOOTHER), "outputscale": 2.0 * math.log(SMOOTHER)} if index % 2 else {}
    shifted = {}
    for name, value in moments.items():
        if not name.startswith("kernels."):  # as in `LatentKernels.initial_parameters`
            shifted[name] = value
            continue
        shift = next((shift for part, shift in shifts.items() if name.endswith(part)), 0.0)
        factors = torch.as_tensor(generator.standard_normal(tuple(value.shape)), device=value.device)
        shifted[name] = value + shift + RESTART_SPREAD * factors
    return shifted


def run_restarts(search: Callable[..., Outcome], restarts: int, patience: int, jobs: Jobs) -> Sequence[Outcome]:
    """`search(index, before=outcomes)` from 0 on, so many at once, on which outcomes do not depend.

    Those before are given with `patience` only, and then `AT_ONCE` run at once.
    """
    outcomes: list[Outcome] = []
    while len(outcomes) < restarts:
        last = min(restarts, len(outcomes) + AT_ONCE) if patience else restarts
        one = partial(search, before=tuple(outcomes))
        outcomes += mapped(one, range(len(outcomes), last), 1 if restarts == 1 and isinstance(jobs, int) else jobs)
    return outcomes


def best_value(found: Sequence[inference.OptimizationResult | FitError]) -> float:
    """The lowest objective that was found; infinite where there is none."""
    return min((each.value for each in found if isinstance(each, inference.OptimizationResult)), default=math.inf)


Starts = Callable[[int], Mapping[str, Tensor]]
"""Number of a start -> the parameters at which it begins."""


@dataclass(frozen=True, eq=False)
class FitObjective:
    """The objective of the free hyper-parameters, with their priors; a class so that processes can receive it."""

    likelihood: Any  # a MarginalLikelihood, or one of another model: (kernels, parameters) -> nats, with its `training`
    kernels: inference.LatentKernels
    noise: Noise
    fixed: Mapping[str, Tensor]

    def __call__(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """In nats; differentiable once in every parameter."""
        return self.likelihood(self.kernels, {**self.fixed, **parameters}) - self.log_prior(parameters)

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, ""]:
        """Log density of the hyper-parameters' priors."""
        return self.kernels.log_prior(parameters) + self.noise.log_prior(parameters)


def with_variance_priors(kernels: inference.LatentKernels) -> inference.LatentKernels:
    """A copy of which every output scale carries the prior log variance ~ N(log of its present value, 2^2)."""
    # the likelihood is flat below the noise: a variance could run off to zero, with too small standard errors
    out = deepcopy(kernels)
    for module in out.modules():
        if isinstance(module, ScaleKernel) and "outputscale_prior" not in [name for name, *_ in module.named_priors()]:
            register_log_normal_prior(module, "outputscale", torch.as_tensor(module.outputscale), LOG_VARIANCE_SPREAD)
    return out


@dataclass(frozen=True, eq=False)
class Search:
    """How a fit searches for hyper-parameters, as `forcegp.fit` documents. InvalidInput for numbers out of range."""

    jobs: Jobs
    restarts: int | None
    seed: int
    options: inference.OptimizerOptions | None
    start: Mapping[str, Tensor] | None

    @usable_arguments("fit")
    def __post_init__(self) -> None:
        restarts = 1 if self.restarts is None else self.restarts
        whole_number("restarts", restarts, 1, MOST_RESTARTS, "the most that one search runs")
        whole_number("seed", self.seed, 0)
        if self.options is not None:
            require_type("options", self.options, inference.OptimizerOptions)

    def resolved(self, rows: int) -> tuple[int, inference.OptimizerOptions]:
        """Restarts and options for so many rows."""
        usual = 4 if rows <= MOST_POINTS_FOR_RESTARTS else 1
        return usual if self.restarts is None else self.restarts, self.options or default_options(rows)

    def starts(self, moments: Mapping[str, Tensor], fixed: Mapping[str, Tensor]) -> Starts:
        """Start `index`: 0 is the moments, with what `start` gives in their place, others lie around the moments."""
        return partial(started, moments, first_start(moments, self.start or {}, fixed), self.seed)

    def best(self, objective: FitObjective, starts: Starts) -> tuple[inference.OptimizationResult, dict[str, Any]]:
        """The best of all starts with the work of all, and its settings. Raises FitError where none could begin."""
        restarts, options = self.resolved(len(objective.likelihood.training))
        one = partial(_one_start, objective, starts, options, restarts)
        with blas_threads(objective.likelihood.training.q.numel()):
            results = run_restarts(one, restarts, options.patience, self.jobs)
        usable = [result for result in results if isinstance(result, inference.OptimizationResult)]
        if not usable:
            causes = "; ".join(f"restart {k}: {error}" for k, error in enumerate(results))
            raise FitError(f"none of {restarts} restarts could be evaluated ({causes})")
        work: Any = {name: sum(getattr(x, name) for x in usable) for name in ("evaluations", "cpu_seconds")}
        settings = {
            "restarts": restarts,
            "warm_start": self.start is not None,
            "seed": self.seed,
            "optimizer": asdict(options),
            "restart_objective": [
                each.value if isinstance(each, inference.OptimizationResult) else None for each in results
            ],
            "restart_status": [
                each.status if isinstance(each, inference.OptimizationResult) else str(each) for each in results
            ],
        }
        return replace(inference.best_of(usable), **work), settings


def _one_start(
    objective: FitObjective,
    starts: Starts,
    options: inference.OptimizerOptions,
    restarts: int,
    index: int,
    before: Sequence[inference.OptimizationResult | FitError],
) -> inference.OptimizationResult | FitError:
    """Where the search from start `index` ended, or why it could not begin."""
    name = f"start {index + 1} of {restarts}, " if restarts > 1 else ""
    try:
        with part(index, restarts, name):
            return inference.minimize_objective(objective, starts(index), options, best_value(before))
    except FitError as error:
        return error


CONTENT, CONFIDENCE = 0.9, 0.995
"""Share of the states that lie inside their 95 % intervals, in this share of the functions that the data leave open."""

STATES = 24  # training states at which functions and variances are compared

DRAWS = 2000

LARGEST_STEP = 2.0  # most that a parameter is moved by, on its log scale: the spread of the widest prior on one

PROBES, SMALL_STEP = 8, 1e-2
"""Directions, and the step along each, whose change of the gradient gives the diagonal of the Hessian: neighbours, as
parameters of one kernel are, do not mix."""

PAIRS, RARE = 4, 0.6
"""Of opposite moves of all hyper-parameters; deviations beyond the mean that 73 % of normal draws do not lose."""

NEGLIGIBLE = 1e-6  # standard deviation, as a fraction of the largest, below which a constraint leaves nothing open


def widened(posterior: Posterior) -> Posterior:
    """The posterior with its `widening`, at least 1; without latents, itself."""
    if not len(posterior.kernels.kernels):
        return posterior
    with torch.no_grad(), blas_threads(posterior.training.q.numel()):
        states = _States(posterior)
        assert isinstance(posterior.latent, ExactPosterior), "fits are exact"
        factor = states.content_factor(posterior.latent)
        if len(posterior.training) <= MOST_POINTS_FOR_RESTARTS:  # beyond, parameters are known well, and searches long
            factor *= states.mixture_factor(posterior)
    return posterior.with_settings(widening=factor)


class _States:
    """Some training states of a posterior, and the accelerations there as linear functions of the latents."""

    def __init__(self, posterior: Posterior) -> None:
        training = posterior.training
        count = len(training.q)
        self.rows = torch.linspace(0, count - 1, min(STATES, count), device=training.q.device).round().long()
        dynamics = posterior.dynamics(*(x[self.rows] for x in (training.q, training.v, training.u)))
        self.W: Float[Tensor, "n nv C"] = dynamics.H @ posterior.trained.unknown.direction(dynamics)
        self.features = posterior.likelihood.standardization(posterior.trained.unknown.features(dynamics))

    def content_factor(self, latent: ExactPosterior) -> float:
        """What makes `CONTENT` of the states lie inside, in `CONFIDENCE` of the functions; at least 1."""
        n, nv, latents = self.W.shape
        # every state has latents of its own: (n nv) accelerations from (C n) values
        linear = torch.diag_embed(self.W.permute(1, 2, 0)).permute(2, 0, 1, 3).reshape(n * nv, latents * n)
        covariance = linear @ latent.joint_covariance(self.features) @ linear.mT
        std = covariance.diagonal().clamp_min(0.0).sqrt()
        open_ones = std > NEGLIGIBLE * std.max()
        if not bool(open_ones.any()):
            return 1.0
        values, vectors = torch.linalg.eigh(0.5 * (covariance + covariance.mT))
        generator = torch.Generator(device=std.device).manual_seed(0)
        normal = torch.randn(len(values), DRAWS, generator=generator, dtype=std.dtype, device=std.device)
        drawn = (vectors * values.clamp_min(0.0).sqrt()) @ normal
        inside = torch.quantile((drawn[open_ones] / std[open_ones, None]).abs(), CONTENT, dim=0)
        return max(1.0, float(torch.quantile(inside, CONFIDENCE)) / DEVIATIONS)

    def mixture_factor(self, posterior: Posterior) -> float:
        """Standard deviations with the hyper-parameters unknown, over those with them known; at least 1.

        Each hyper-parameter is a standard deviation up or down (Laplace, with the diagonal of the Hessian: Bekas,
        Kokiopoulou & Saad 2007, Applied Numerical Mathematics 57), or less where the likelihood falls sooner than that
        tells, as along parameters that go together. Rows are predicted from the others.
        """
        likelihood, kernels = posterior.likelihood, posterior.kernels
        _, fixed = likelihood.split_noise
        free = {name: value.detach() for name, value in posterior.hyperparameters.items() if name not in fixed}
        objective = FitObjective(likelihood, kernels, likelihood.noise, fixed)
        start = torch.cat([x.reshape(-1) for x in free.values()])

        def named(x: Tensor) -> dict[str, Tensor]:
            parts = zip(free.items(), x.split([each.numel() for each in free.values()]), strict=True)
            return {name: part.reshape(like.shape) for (name, like), part in parts}

        def with_gradient(x: Tensor) -> tuple[float, Tensor]:
            with torch.enable_grad():
                value = objective(named(x := x.clone().requires_grad_()))
                return float(value.detach()), torch.autograd.grad(value, x)[0]

        value, here = with_gradient(start)
        curvature = torch.zeros_like(start)
        for sign in np.tile(hadamard(PROBES), len(start) // PROBES + 1)[:, : len(start)]:
            along = torch.tensor(sign).to(start)
            with contextlib.suppress(NumericalError):  # at the edge of what can be computed: not known to be steep
                curvature += along * (with_gradient(start + SMALL_STEP * along)[1] - here) / (SMALL_STEP * PROBES)
        spread = curvature.clamp_min(LARGEST_STEP**-2) ** -0.5
        told = 0.5 * float((curvature.clamp_min(0.0) * spread.square()).sum())
        usual = told + RARE * math.sqrt(told)  # what draws of a normal posterior lose: Gamma(n / 2)
        mean, variance = self._without_own(posterior.latent)
        more, scratch = [], kernels.at(free)
        draws = np.random.default_rng(0).choice((-1.0, 1.0), (PAIRS, len(start)))
        for sign in (side * each for each in draws for side in (1.0, -1.0)):
            moved = named(start + torch.tensor(sign).to(start) * spread)
            try:
                lost, at = float(objective(moved)) - value, scratch.moved_to(moved | fixed)
                other = self._without_own(likelihood.condition(at, moved | fixed, at_parameters=True))
            except (NumericalError, torch.linalg.LinAlgError):
                continue  # no posterior there: nothing that the data leave open
            more.append(((other[0] - mean).square() + other[1] - variance) * (usual / max(lost, usual, 1e-300)))
        open_ones = variance > NEGLIGIBLE**2 * variance.max()
        if not more or not bool(open_ones.any()):
            return 1.0
        return math.sqrt(max(1.0, 1.0 + float((torch.stack(more).mean(0) / variance)[open_ones].mean())))

    def _without_own(self, latent: inference.LatentPosterior) -> tuple[Float[Tensor, "n nv"], Float[Tensor, "n nv"]]:
        """Mean and variance of the accelerations that the latents make, by all rows but that of the state itself."""
        # f + S C^T B^-1 C S and so on, with B = (T^-1)_ii (Rasmussen & Williams 2006, section 5.4.2)
        assert isinstance(latent, ExactPosterior), "fits are exact"
        system, n = latent.system, len(self.rows)
        C, alpha = system.deflation.C[self.rows], system.alpha[self.rows]
        count, rank = system.alpha.shape
        own = (self.rows[:, None] * rank + torch.arange(rank, device=self.rows.device)).reshape(-1)
        columns = torch.zeros(count * rank, n * rank, dtype=C.dtype, device=C.device)
        columns[own, torch.arange(n * rank, device=own.device)] = 1.0
        B = system.factor.solve(columns)[own].reshape(n, rank, n, rank).diagonal(dim1=0, dim2=2).permute(2, 0, 1)
        S = latent.covariance(self.features)
        gain = torch.linalg.solve(B, C @ S).mT
        f = latent.mean(self.features) - (gain @ alpha[..., None])[..., 0]
        return (self.W @ f[..., None])[..., 0], (self.W @ (S + gain @ C @ S) @ self.W.mT).diagonal(dim1=-2, dim2=-1)
