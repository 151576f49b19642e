"""`IndependentGP`: one Gaussian process per joint acceleration, without physics; the paper's baseline "GP"."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor
from typing_extensions import override

from forcegp.data import Dataset
from forcegp.errors import FitError, InvalidInput, require_type
from forcegp.inference import Engine, LatentKernels, OptimizationResult, OptimizerOptions, minimize_objective
from forcegp.inference.memory import require_memory
from forcegp.mechanics import MechanicalSystem
from forcegp.models.baselines.independent_posterior import (
    IndependentLikelihood,
    IndependentPosterior,
    joint_part,
    one_joint,
)
from forcegp.models.protocol import Model
from forcegp.models.search import (
    FitProgress,
    best_value,
    blas_threads,
    check_search_numbers,
    check_system_and_noise,
    default_restarts,
    described_rows,
    first_start,
    perturbed,
    resolved_noise,
    run_restarts,
    training_rows,
)
from forcegp.models.training_data import ACCELERATION, Noise, TrainingData
from forcegp.parallel import Backend, backend_for
from forcegp.priors import JointForces

Outcomes = list[OptimizationResult | FitError]
Value = TypeVar("Value")

SEARCH = OptimizerOptions(slow=0.05, patience=5)
"""Of every joint, whose few parameters show soon which start is the best."""


@dataclass(frozen=True, eq=False)
class IndependentGP(Model):
    """a_j = f_j(q, v, u) + noise, with one zero-mean Gaussian process f_j per joint and nothing shared between joints.

    It has no mass matrix and no contact: the baseline "GP" of Rath et al. (2021), the row "independent GP" of every
    comparison. Each of the nv problems has N rows, so that a fit costs nv N^3 and not (nv N)^3.

    Parameters
    ----------
    system: what the robot is; its joints name the outputs, and its contacts are those that predictions are checked on.
    inputs: which of "q", "v" and "u" the accelerations may depend on.
    noise: as in `StructuredGP`, of the acceleration only: without a mass matrix there is no noise of forces.
    """

    system: MechanicalSystem
    inputs: tuple[str, ...] = ("q", "v", "u")
    noise: Noise | None = None

    def __post_init__(self) -> None:
        check_system_and_noise(self)
        object.__setattr__(self, "inputs", JointForces(self.inputs).inputs)
        if self.noise is not None and self.noise.force is not None:
            raise InvalidInput(
                "an IndependentGP has no noise of forces, for it has no mass matrix; give Noise(acceleration) alone."
            )

    def fit(
        self,
        dataset: Dataset,
        *,
        points: int | None = None,
        restarts: int | None = None,
        seed: int = 0,
        jobs: int | None = None,
        backend: Backend | str | None = None,
        hyperprior: bool = True,
        options: OptimizerOptions | None = None,
        start: Mapping[str, Tensor] | None = None,
        progress: FitProgress | None = None,
    ) -> IndependentPosterior:
        """Find the kernel and learned noise parameters of every joint in a search of its own, then condition.

        All arguments mean what they mean in `StructuredGP.fit`, and the starts are the same, too; of several starts
        every joint keeps its own best. `progress(restart, iteration, objective)` reports the iteration that the joints
        are at on average, and the objective of the joint that is searched.

        Raises
        ------
        InvalidInput: the dataset does not fit the robot, or an argument is out of range.
        FitError: no restart could be evaluated for some joint; the message names it and the cause.
        NotEnoughMemory: the covariances of so many rows would need more than is free.
        """
        workers = backend_for(backend, jobs)
        rows = training_rows(self.system.robot.joint_names, dataset, points)
        noise = resolved_noise(self.noise, rows)
        restarts = default_restarts(len(rows)) if restarts is None else restarts
        check_search_numbers(restarts, seed)
        nv, device = self.system.robot.nv, self.system.robot.device
        needed = 8 * len(rows) ** 2 * (nv + 4)  # a factor for every joint, and what the gradients of one of them take
        require_memory(needed, f"an IndependentGP of N={len(rows)} rows", "give fewer `points`", device)
        training = TrainingData.of(rows, device)
        likelihood = IndependentLikelihood(self.inputs, training)
        kernels = likelihood.kernels()
        noise_parameters = noise.parameters(self.system.robot.nv, self.system.robot.device)
        fixed = {} if noise.learn else noise_parameters
        moments = kernels.initial_parameters() | (noise_parameters if noise.learn else {})
        options = require_type("options", SEARCH if options is None else options, OptimizerOptions)
        objectives = tuple(
            _JointObjective(likelihood, joint, one_joint(kernels, joint), noise, joint_part(fixed, joint), hyperprior)
            for joint in range(self.system.robot.nv)
        )
        search = _JointSearches(objectives, moments, first_start(moments, start or {}, fixed), seed, options)
        with blas_threads(len(rows)):
            outcomes = run_restarts(search, restarts, options.patience, workers, progress)
        result = self._chosen(outcomes)
        settings = {
            **described_rows(rows, dataset),
            "restarts": restarts,
            "warm_start": start is not None,
            "seed": seed,
            "inputs": list(self.inputs),
            "noise": noise.to_dict(),
            "optimizer": {name: getattr(options, name) for name in options.__dataclass_fields__},
            "hyperprior": hyperprior,
            "restart_objective": [_total(each) for each in outcomes],
            "restart_status": [[getattr(found, "status", str(found)) for found in each] for each in outcomes],
        }
        fitted = IndependentGP(self.system, self.inputs, noise)
        return fitted.condition(training, result.parameters | fixed, result, settings)

    def _chosen(self, outcomes: Sequence[Outcomes]) -> OptimizationResult:
        """Of every joint the best start, all joints as one result whose objective is the sum."""
        best: list[OptimizationResult] = []
        for joint, name in enumerate(self.system.robot.joint_names):
            usable = [each[joint] for each in outcomes]
            found = [result for result in usable if isinstance(result, OptimizationResult)]
            if not found:
                causes = "; ".join(f"restart {k}: {error}" for k, error in enumerate(usable))
                raise FitError(f"none of {len(outcomes)} restarts could be evaluated for joint {name} ({causes})")
            best.append(min(found, key=lambda result: result.value))
        every = [result for each in outcomes for result in each if isinstance(result, OptimizationResult)]
        steps, kept = (max(len(getattr(result, name)) for result in best) for name in ("history", "iterates"))
        return OptimizationResult(
            parameters=_all_joints([result.parameters for result in best]),
            value=sum(result.value for result in best),
            history=tuple(sum(_at(result.history, k) for result in best) for k in range(steps)),
            status=_sentence(self.system.robot.joint_names, best, len(outcomes)),
            converged=all(result.converged for result in best),
            evaluations=sum(result.evaluations for result in every),
            cpu_seconds=sum(result.cpu_seconds for result in every),
            iterates=tuple(_all_joints([_at(result.iterates, k) for result in best]) for k in range(kept)),
        )

    @override
    def condition(
        self,
        training: TrainingData,
        parameters: Mapping[str, Tensor],
        result: OptimizationResult,
        settings: Mapping[str, Any],
        engine: Engine | None = None,
        solution: Tensor | None = None,
    ) -> IndependentPosterior:
        likelihood = IndependentLikelihood(self.inputs, training)
        kernels = likelihood.kernels()
        latents = tuple(  # now: a failure belongs to the fit, not to the first prediction
            likelihood.condition(joint, one_joint(kernels, joint), joint_part(parameters, joint))
            for joint in range(self.system.robot.nv)
        )
        return IndependentPosterior(self, likelihood, dict(parameters), result, dict(settings), latents)

    @override
    def parameter_shapes(self, training: TrainingData) -> dict[str, tuple[int, ...]]:
        kernels = IndependentLikelihood(self.inputs, training).kernels()
        named = kernels.initial_parameters() | (self.noise or Noise()).parameters(self.system.robot.nv)
        return {name: tuple(value.shape) for name, value in named.items()}


@dataclass(frozen=True, eq=False)
class _JointObjective:
    """What one joint's search lowers, as a function of that joint's free parameters."""

    likelihood: IndependentLikelihood
    joint: int
    kernels: LatentKernels
    noise: Noise
    fixed: Mapping[str, Tensor]
    hyperprior: bool

    def __call__(self, parameters: Mapping[str, Tensor]) -> Tensor:
        value = self.likelihood(self.joint, self.kernels, {**self.fixed, **parameters})
        if not self.hyperprior:
            return value
        value = value - self.kernels.log_prior(parameters)
        if ACCELERATION in parameters:
            a = self.likelihood.training.a
            given = self.noise.parameters(a.shape[-1], a.device)[ACCELERATION][self.joint]
            value = value - Noise(float(given.exp())).log_prior(parameters, 1)
        return value


@dataclass(frozen=True, eq=False)
class _JointSearches:
    """The searches of all joints, one after the other, from start number `index`."""

    objectives: tuple[Callable[[Mapping[str, Tensor]], Tensor], ...]
    moments: Mapping[str, Tensor]
    first: Mapping[str, Tensor]
    seed: int
    options: OptimizerOptions

    def __call__(self, index: int, before: Sequence[Outcomes], progress: FitProgress | None) -> Outcomes:
        first = perturbed(self.moments, self.seed, index) if index else self.first
        outcomes: Outcomes = []
        steps = self.options.iterations
        for joint, objective in enumerate(self.objectives):

            def note(iteration: int, value: float, joint: int = joint) -> None:
                if progress is not None:
                    progress(index, (joint * steps + min(iteration, steps)) // len(self.objectives), value)

            try:
                rival = best_value([each[joint] for each in before])
                outcomes.append(minimize_objective(objective, joint_part(first, joint), self.options, note, rival))
            except FitError as error:
                outcomes.append(error)
        return outcomes


def _all_joints(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """The parameters of all joints under the names that a `LatentKernels` of all kernels has."""
    joined = {
        name.replace("kernels.0.", f"kernels.{joint}.", 1): value
        for joint, part in enumerate(parts)
        for name, value in part.items()
        if name != ACCELERATION
    }
    if ACCELERATION in parts[0]:
        joined[ACCELERATION] = torch.cat([part[ACCELERATION] for part in parts])
    return joined


def _at(values: Sequence[Value], k: int) -> Value:
    """The value after iteration k of a search; one that has ended stays where it is."""
    return values[min(k, len(values) - 1)]


def _total(outcomes: Outcomes) -> float | None:
    values = [result.value for result in outcomes if isinstance(result, OptimizationResult)]
    return sum(values) if len(values) == len(outcomes) else None


def _sentence(names: Sequence[str], results: Sequence[OptimizationResult], restarts: int) -> str:
    """How the searches ended: once for all joints, or for every joint where they differ."""
    joints: dict[str, list[str]] = {}
    for name, result in zip(names, results, strict=True):
        joints.setdefault(result.status, []).append(name)
    parts = [status if len(joints) == 1 else f"{', '.join(who)}: {status}" for status, who in joints.items()]
    return "; ".join(parts) + (f" (every joint the best of {restarts} starts)" if restarts > 1 else "")
