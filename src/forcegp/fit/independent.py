"""One Gaussian process per joint acceleration, without physics; the paper's baseline "GP"."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from forcegp.data import Dataset, farthest_rows
from forcegp.errors import InvalidInput
from forcegp.evidence import TrainingData
from forcegp.fit.objective import FitObjective, Search, Starts
from forcegp.fit.search import FitProgress, described_rows, resolved_noise
from forcegp.inference import OptimizationResult, OptimizerOptions
from forcegp.inference.memory import require_memory
from forcegp.inference.threads import blas_threads
from forcegp.model import Model
from forcegp.noise import ACCELERATION, Noise
from forcegp.posterior.independent import (
    IndependentLikelihood,
    IndependentPosterior,
    JointLikelihood,
    joint_part,
    one_joint,
)
from forcegp.robots.arguments import whole_number

Value = TypeVar("Value")

SEARCH = OptimizerOptions(slow=0.05, patience=5)
"""Of every joint, whose few parameters show soon which start is the best."""


def fit_independent(model: Model, dataset: Dataset, points: int | None, search: Search) -> IndependentPosterior:
    """Kernel and learned noise parameters of every joint by a search of its own, then the posterior.

    The starts are those of other fits; of several every joint keeps its own best. `progress(restart, iteration,
    objective)` reports the iteration of the joints on average, and the objective of the joint that is searched.

    Raises
    ------
    InvalidInput: the model has other forces, or noise of them.
    FitError: no restart could be evaluated for some joint; the message names it and the cause.
    NotEnoughMemory: the covariances of so many rows would need more than is free.
    """
    forces = list(model.unknown_forces)
    if len(forces) > 1 or any(law.learned for law in model.laws):
        raise InvalidInput(
            "IndependentAccelerations are a model's only force, without physics: model.black_box() has it alone."
        )
    if model.noise is not None and model.noise.force is not None:
        raise InvalidInput(
            "independent accelerations have no mass matrix, so no noise of forces; give Noise(acceleration)."
        )
    search = search if search.options is not None else replace(search, options=SEARCH)
    progress, options, inputs = search.progress, search.options, forces[-1].inputs
    assert options is not None, "it was set"
    rows = dataset
    if points is not None and whole_number("points", points, 2, len(dataset), "the rows of the dataset") < len(dataset):
        rows = farthest_rows(dataset, points)
    noise = resolved_noise(model.noise, rows)
    nv, device = model.robot.nv, model.robot.device
    needed = 8 * len(rows) ** 2 * (nv + 4)  # a factor for every joint, and what the gradients of one of them take
    require_memory(needed, f"independent processes of N={len(rows)} rows", "give fewer `points`", device)
    training = TrainingData.of(rows, device)
    likelihood = IndependentLikelihood(inputs, training)
    kernels = likelihood.kernels()
    noise_parameters = noise.parameters(nv, device)
    fixed = {} if noise.learn else noise_parameters
    moments = kernels.initial_parameters() | (noise_parameters if noise.learn else {})
    starts = search.starts(moments, fixed)
    found: list[tuple[OptimizationResult, dict[str, Any]]] = []
    with blas_threads(len(rows)):
        for joint, name in enumerate(model.robot.joint_names):
            level = Noise(float(noise_parameters[ACCELERATION][joint].exp()), learn=noise.learn)
            own = JointLikelihood(likelihood, joint), one_joint(kernels, joint), level, joint_part(fixed, joint)
            note = None if progress is None else partial(_note, progress, joint, nv, options.iterations)
            objective, its_starts = FitObjective(*own, search.hyperprior), partial(_of_joint, starts, joint)
            found.append(replace(search, progress=note).best(objective, its_starts, what=f" for joint {name}"))
    result = _joined(model.robot.joint_names, [each for each, _ in found])
    objectives, statuses = (
        [list(each) for each in zip(*(of_search[name] for _, of_search in found), strict=True)]
        for name in ("restart_objective", "restart_status")
    )
    settings = {
        **described_rows(rows, dataset),
        **found[0][1],
        "inputs": list(inputs),
        "noise": noise.to_dict(),
        "restart_objective": [None if None in each else sum(each) for each in objectives],
        "restart_status": statuses,
    }
    fitted = replace(model, noise=noise)
    return IndependentPosterior.conditioned(fitted, training, result.parameters | fixed, result, settings)


def _joined(names: Sequence[str], best: Sequence[OptimizationResult]) -> OptimizationResult:
    """All joints as one result whose objective is the sum."""
    steps, kept = (max(len(getattr(result, name)) for result in best) for name in ("history", "iterates"))
    return OptimizationResult(
        parameters=_all_joints([result.parameters for result in best]),
        value=sum(result.value for result in best),
        history=tuple(sum(_at(result.history, k) for result in best) for k in range(steps)),
        status=_sentence(names, best),
        converged=all(result.converged for result in best),
        evaluations=sum(result.evaluations for result in best),
        cpu_seconds=sum(result.cpu_seconds for result in best),
        iterates=tuple(_all_joints([_at(result.iterates, k) for result in best]) for k in range(kept)),
    )


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
