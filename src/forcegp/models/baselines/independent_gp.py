"""`IndependentGP`: one Gaussian process per joint acceleration, without physics; the paper's baseline "GP"."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor
from typing_extensions import override

from forcegp.data import Dataset
from forcegp.errors import InvalidInput, require_type
from forcegp.inference import Engine, OptimizationResult, OptimizerOptions
from forcegp.inference.memory import require_memory
from forcegp.mechanics import MechanicalSystem
from forcegp.models.baselines.independent_posterior import (
    IndependentLikelihood,
    IndependentPosterior,
    JointLikelihood,
    joint_part,
    one_joint,
)
from forcegp.models.protocol import Model
from forcegp.models.search import (
    FitProgress,
    blas_threads,
    check_system_and_noise,
    described_rows,
    resolved_noise,
    training_rows,
)
from forcegp.models.structured.search import FitObjective, Search, Starts
from forcegp.models.training_data import ACCELERATION, Noise, TrainingData
from forcegp.parallel import Backend, backend_for
from forcegp.priors import JointForces

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
        options = require_type("options", SEARCH if options is None else options, OptimizerOptions)
        search = Search(backend_for(backend, jobs), restarts, seed, hyperprior, options, start, progress)
        rows = training_rows(self.system.robot.joint_names, dataset, points)
        noise = resolved_noise(self.noise, rows)
        nv, device = self.system.robot.nv, self.system.robot.device
        needed = 8 * len(rows) ** 2 * (nv + 4)  # a factor for every joint, and what the gradients of one of them take
        require_memory(needed, f"an IndependentGP of N={len(rows)} rows", "give fewer `points`", device)
        training = TrainingData.of(rows, device)
        likelihood = IndependentLikelihood(self.inputs, training)
        kernels = likelihood.kernels()
        noise_parameters = noise.parameters(nv, device)
        fixed = {} if noise.learn else noise_parameters
        moments = kernels.initial_parameters() | (noise_parameters if noise.learn else {})
        starts = search.starts(moments, fixed)
        found: list[tuple[OptimizationResult, dict[str, Any]]] = []
        with blas_threads(len(rows)):
            for joint, name in enumerate(self.system.robot.joint_names):
                level = Noise(float(noise_parameters[ACCELERATION][joint].exp()), learn=noise.learn)
                own = JointLikelihood(likelihood, joint), one_joint(kernels, joint), level, joint_part(fixed, joint)
                note = None if progress is None else partial(_note, progress, joint, nv, options.iterations)
                objective, its_starts = FitObjective(*own, hyperprior), partial(_of_joint, starts, joint)
                found.append(replace(search, progress=note).best(objective, its_starts, what=f" for joint {name}"))
        result = self._joined([each for each, _ in found])
        objectives, statuses = (
            [list(each) for each in zip(*(of_search[name] for _, of_search in found), strict=True)]
            for name in ("restart_objective", "restart_status")
        )
        settings = {
            **described_rows(rows, dataset),
            **found[0][1],
            "inputs": list(self.inputs),
            "noise": noise.to_dict(),
            "restart_objective": [None if None in each else sum(each) for each in objectives],
            "restart_status": statuses,
        }
        fitted = IndependentGP(self.system, self.inputs, noise)
        return fitted.condition(training, result.parameters | fixed, result, settings)

    def _joined(self, best: Sequence[OptimizationResult]) -> OptimizationResult:
        """All joints as one result whose objective is the sum."""
        steps, kept = (max(len(getattr(result, name)) for result in best) for name in ("history", "iterates"))
        return OptimizationResult(
            parameters=_all_joints([result.parameters for result in best]),
            value=sum(result.value for result in best),
            history=tuple(sum(_at(result.history, k) for result in best) for k in range(steps)),
            status=_sentence(self.system.robot.joint_names, best),
            converged=all(result.converged for result in best),
            evaluations=sum(result.evaluations for result in best),
            cpu_seconds=sum(result.cpu_seconds for result in best),
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


def _of_joint(starts: Starts, joint: int, index: int) -> dict[str, Tensor]:
    return joint_part(starts(index), joint)


def _note(
    progress: FitProgress, joint: int, joints: int, steps: int, restart: int, iteration: int, value: float
) -> None:
    """Report the iteration that the joints are at on average."""
    progress(restart, (joint * steps + min(iteration, steps)) // joints, value)


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


def _sentence(names: Sequence[str], results: Sequence[OptimizationResult]) -> str:
    """How the searches ended: once for all joints, or for every joint where they differ."""
    joints: dict[str, list[str]] = {}
    for name, result in zip(names, results, strict=True):
        joints.setdefault(result.status, []).append(name)
    parts = [status if len(joints) == 1 else f"{', '.join(who)}: {status}" for status, who in joints.items()]
    return "; ".join(parts)
