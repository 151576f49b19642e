"""`StructuredGP`: Gaussian processes on the unknown forces inside known constrained rigid-body dynamics."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, get_args

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from forcegp.data import Dataset, farthest_rows
from forcegp.errors import DataWarning, FitError, InvalidInput
from forcegp.inference import (
    LatentKernels,
    OptimizationResult,
    OptimizerOptions,
    best_of,
    minimize_objective,
)
from forcegp.mechanics import MechanicalSystem
from forcegp.models.marginal_likelihood import MarginalLikelihood, Mean, TrainingData
from forcegp.models.noise import ACCELERATION, FORCE, Noise
from forcegp.models.structured_posterior import StructuredPosterior
from forcegp.priors import ForcePrior, JointForces, prior_to_dict

RESTART_SPREAD = 0.7
"""Standard deviation of the random factors (natural log) on the start values of restarts 1, 2, ...; restart 0 has
none.
"""

SMOOTHER = 4.0
"""Factor on the length scales of odd restarts: measured, these escape the local optima of the start from moments."""

MOST_POINTS_FOR_RESTARTS = 400
"""Training points up to which several starts are the default."""

FAR_FROM_SURFACE = 0.01
"""Median distance of the training points from a contact's surface, in m, beyond which a warning is given."""

SMALL_COVARIANCE = 2000
"""Rows of the full covariance below which one thread is faster than several (measured on 2 cores)."""


def default_restarts(points: int) -> int:
    """Starts of the search where none are asked for."""
    return 4 if points <= MOST_POINTS_FOR_RESTARTS else 1


FitProgress = Callable[[int, int, float], None]


@dataclass(frozen=True, eq=False)
class StructuredGP:
    """a = M^-1 Q_b + H (Q_K + B f) + noise with f ~ GP (Rath et al. 2021, eq. 6; eq. 7 with the analytical mean).

    Parameters
    ----------
    system: robot, contacts and known forces, for example `dataset.system`.
    prior: the unknown force Q_U = B f; the default is one Gaussian process per joint on (q, v, u).
    mean: "analytical" keeps the known forces Q_K in the mean; "zero" drops them, so that the processes carry Q_K + Q_U.
    noise: measurement noise, a `Noise` or just its standard deviation. None takes `dataset.noise_std`, and raises if
        the dataset does not know it: then pass `Noise(0.1, learn=True)` to learn it.
    """

    # This constructor is the check, with messages for people; run-time checks of annotations must not come before it.
    __no_type_check__: ClassVar[bool] = True

    system: MechanicalSystem
    prior: ForcePrior = field(default_factory=JointForces)
    mean: Mean = "analytical"
    noise: Noise | None = None

    def __post_init__(self) -> None:
        for name, kind in (("system", MechanicalSystem), ("prior", ForcePrior)):
            if not isinstance(getattr(self, name), kind):
                given = type(getattr(self, name)).__name__
                raise InvalidInput(f"{name} is a {given}; give a {kind.__name__}, for example system=dataset.system")
        if self.noise is not None and not isinstance(self.noise, Noise):
            object.__setattr__(self, "noise", Noise(self.noise))
        if self.mean not in get_args(Mean):
            raise InvalidInput(f"mean is {self.mean!r}; allowed: {', '.join(map(repr, get_args(Mean)))}")

    def fit(
        self,
        dataset: Dataset,
        *,
        points: int | None = None,
        restarts: int | None = None,
        seed: int = 0,
        jobs: int = 1,
        hyperprior: bool = True,
        options: OptimizerOptions | None = None,
        progress: FitProgress | None = None,
    ) -> StructuredPosterior:
        """Find all kernel and learned noise parameters by marginal likelihood, then condition on the same points.

        Parameters
        ----------
        dataset: rows with the joints of the robot in its order; nothing in it is changed.
        points: train on this many rows, chosen by farthest-point sampling of (q, v, u); None takes all rows.
        restarts: number of starts; the first uses moments of the data, the others multiply these by seeded random
            factors, every other one from a smoother start; the best final value wins. None means 4 up to 400 points,
            where local optima cost most and searches cost little, and 1 beyond.
        seed: of the random factors; restart k uses (seed, k), so its result does not depend on how many there are.
        jobs: processes for the restarts (joblib); results do not depend on it.
        hyperprior: maximise the marginal likelihood times the priors that kernels and learned noise carry (type-II
            maximum a posteriori), which keeps few points calibrated; False is plain type-II maximum likelihood.
        options: the search itself.
        progress: called as progress(restart, iteration, nll) with jobs = 1.

        Raises
        ------
        InvalidInput: the dataset does not fit the system, or an argument is out of range.
        ContactError: a contact cannot hold at some row.
        FitError: no restart could be evaluated; the message names the cause.
        """
        noise = self._resolved_noise(dataset)
        rows = self._training_rows(dataset, points)
        restarts = default_restarts(len(rows)) if restarts is None else restarts
        if restarts < 1 or jobs < 1:
            raise InvalidInput(f"restarts={restarts} and jobs={jobs} must be at least 1")
        if seed < 0:
            raise InvalidInput(f"seed={seed} must be 0 or larger")
        device = self.system.robot.device
        training = TrainingData(*(torch.tensor(x, device=device) for x in (rows.q, rows.v, rows.u, rows.a)))
        likelihood = self._likelihood(training)
        self.system.check_states(training.q, training.v, training.u)
        _warn_of_distance(self.system, training)
        kernels = likelihood.kernels()
        noise_parameters = noise.parameters(self.system.robot.nv)
        fixed = {} if noise.learn else noise_parameters
        start = kernels.initial_parameters() | (noise_parameters if noise.learn else {})
        options = options or OptimizerOptions()
        search = _Search(_Objective(likelihood, kernels, noise, fixed, hyperprior), start, seed, options)
        with _blas_threads(likelihood):
            results = _run_restarts(search, restarts, jobs, progress)
        usable = [result for result in results if isinstance(result, OptimizationResult)]
        if not usable:
            causes = "; ".join(f"restart {k}: {error}" for k, error in enumerate(results))
            raise FitError(f"none of {restarts} restarts could be evaluated ({causes})")
        result = replace(
            best_of(usable),
            evaluations=sum(search.evaluations for search in usable),
            cpu_seconds=sum(search.cpu_seconds for search in usable),
        )
        settings = {
            "points": len(rows),
            "rows_available": len(dataset),
            "data": {"metadata": dict(dataset.metadata), "episodes": list(dataset.episodes)},
            "restarts": restarts,
            "seed": seed,
            "mean": self.mean,
            "prior": prior_to_dict(self.prior),
            "noise": noise.to_dict(),
            "optimizer": {name: getattr(options, name) for name in options.__dataclass_fields__},
            "hyperprior": hyperprior,
            "restart_objective": [r.value if isinstance(r, OptimizationResult) else None for r in results],
        }
        fitted = StructuredGP(self.system, self.prior, self.mean, noise)
        return fitted._posterior(likelihood, kernels, result.parameters | fixed, result, settings)

    def condition(
        self,
        training: TrainingData,
        parameters: Mapping[str, Tensor],
        result: OptimizationResult,
        settings: Mapping[str, Any],
    ) -> StructuredPosterior:
        """The posterior at given parameters, without optimisation; names as in `MarginalLikelihood`."""
        likelihood = self._likelihood(training)
        return self._posterior(likelihood, likelihood.kernels(), parameters, result, settings)

    def parameter_shapes(self, training: TrainingData) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the kernel and noise parameters that a posterior on these points needs."""
        noise = (self.noise or Noise()).parameters(self.system.robot.nv)
        named = self._likelihood(training).kernels().initial_parameters() | noise
        return {name: tuple(value.shape) for name, value in named.items()}

    def _posterior(
        self,
        likelihood: MarginalLikelihood,
        kernels: LatentKernels,
        parameters: Mapping[str, Tensor],
        result: OptimizationResult,
        settings: Mapping[str, Any],
    ) -> StructuredPosterior:
        posterior = StructuredPosterior(self, likelihood, kernels, dict(parameters), result, dict(settings))
        _ = posterior.latent  # factorise now: a failure belongs to the fit, not to the first prediction
        return posterior

    def _likelihood(self, training: TrainingData) -> MarginalLikelihood:
        return MarginalLikelihood(self.system, self.prior, self.mean, training)

    def _resolved_noise(self, dataset: Dataset) -> Noise:
        if self.noise is not None:
            return self.noise
        if dataset.noise_std is None:
            raise InvalidInput(
                "the dataset does not know its noise level; pass noise=Noise(0.1) if it is known in rad/s^2, or "
                "noise=Noise(0.1, learn=True) "
                "to learn it from there"
            )
        return Noise(tuple(float(std) for std in dataset.noise_std))

    def _training_rows(self, dataset: Dataset, points: int | None) -> Dataset:
        names = self.system.robot.joint_names
        if tuple(dataset.joint_names) != names:
            raise InvalidInput(
                f"the dataset has joints {', '.join(dataset.joint_names)}; the robot has {', '.join(names)}"
            )
        if len(dataset) < 2:
            raise InvalidInput(f"the dataset has {len(dataset)} rows; at least 2 are needed")
        if points is None:
            return dataset
        if not 2 <= points <= len(dataset):
            raise InvalidInput(f"points={points} is not between 2 and the {len(dataset)} rows of the dataset")
        return farthest_rows(dataset, points)


@dataclass(frozen=True, eq=False)
class _Objective:
    """The marginal likelihood as a function of the free parameters alone; a class so that processes can receive it."""

    likelihood: MarginalLikelihood
    kernels: LatentKernels
    noise: Noise
    fixed: Mapping[str, Tensor]
    hyperprior: bool

    def __call__(self, parameters: Mapping[str, Tensor]) -> Tensor:
        value = self.likelihood(self.kernels, {**self.fixed, **parameters})
        if not self.hyperprior:
            return value
        nv = self.likelihood.system.robot.nv
        return value - self.kernels.log_prior(parameters) - self.noise.log_prior(parameters, nv)


@dataclass(frozen=True, eq=False)
class _Search:
    """One optimisation from start number `index`."""

    objective: _Objective
    start: Mapping[str, Tensor]
    seed: int
    options: OptimizerOptions

    def __call__(self, index: int, progress: FitProgress | None = None) -> OptimizationResult | FitError:
        first = _perturbed(self.start, self.seed, index) if index else self.start
        note = None if progress is None else (lambda iteration, value: progress(index, iteration, value))
        try:
            return minimize_objective(self.objective, first, self.options, note)
        except FitError as error:
            return error


def _warn_of_distance(system: MechanicalSystem, training: TrainingData) -> None:
    """Warn where most training states are far from a surface that is said to hold them."""
    kinematics = system.robot.kinematics(training.q)
    for index, contact in enumerate(system.contacts):
        # divided by |s_p|, which is 1 for signed distances, the value of any surface is a distance near it
        size = torch.linalg.vector_norm(contact.surface.gradient(contact.position(kinematics)), dim=-1)
        distance = float((contact.distance(kinematics) / size).abs().median())
        if distance > FAR_FROM_SURFACE:
            warnings.warn(
                f"half of the training points lie more than {distance:.3g} m from the surface of contact {index} "
                "(frame "
                f"{contact.frame!r}); check its surface, point and units (m), or leave the contact out",
                DataWarning,
                stacklevel=3,
            )


def _perturbed(start: Mapping[str, Tensor], seed: int, index: int) -> dict[str, Tensor]:
    """Kernel parameters shifted by seeded normal numbers on their log scale; the noise keeps its start.

    Odd restarts begin near a linear function, at a multiple of the length scales and its square of the variance.
    """
    generator = np.random.default_rng((seed, index))
    shifts = {"lengthscale": math.log(SMOOTHER), "outputscale": 2.0 * math.log(SMOOTHER)} if index % 2 else {}
    shifted = {}
    for name, value in start.items():
        if name in (ACCELERATION, FORCE):
            shifted[name] = value
            continue
        shift = next((shift for part, shift in shifts.items() if name.endswith(part)), 0.0)
        shifted[name] = value + shift + RESTART_SPREAD * torch.as_tensor(generator.standard_normal(tuple(value.shape)))
    return shifted


def _blas_threads(likelihood: MarginalLikelihood) -> AbstractContextManager[Any]:
    """One BLAS thread while the covariance is small: threads that wait for each other cost up to 10 times as much."""
    rows, joints = likelihood.training.q.shape
    return threadpool_limits(1) if rows * joints <= SMALL_COVARIANCE else nullcontext()


def _run_restarts(
    search: _Search, restarts: int, jobs: int, progress: FitProgress | None
) -> Sequence[OptimizationResult | FitError]:
    if jobs == 1 or restarts == 1:
        return [search(index, progress) for index in range(restarts)]
    from joblib import Parallel, delayed

    return Parallel(n_jobs=min(jobs, restarts))(delayed(search)(index) for index in range(restarts))  # type: ignore[return-value]
