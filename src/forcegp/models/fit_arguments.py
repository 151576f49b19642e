"""What every model asks of the data and numbers that its `fit` is given."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from forcegp.data import Dataset, WindowObservation, Windows, farthest_rows, observation_of
from forcegp.data.dataset_arguments import require_rows
from forcegp.errors import DataWarning, InvalidInput, require_type
from forcegp.mechanics import MechanicalSystem
from forcegp.models.noise import Noise
from forcegp.robots.real_numbers import whole_number

MOST_RESTARTS = 10_000
"""So that a slip such as 10**9 is refused: a start takes from tenths of a second to minutes."""


START_SHARE = 0.1
"""Noise of an acceleration over its spread, from which it is learned; its hyperprior spans a factor of e about that."""

QUIET = 1e-3
"""Spread of a joint that hardly moves, as a fraction of the largest."""


def check_system_and_noise(model: Any) -> None:
    """What every constructor asks: `system` is a MechanicalSystem, and a bare number as `noise` becomes a `Noise`.

    Raises InvalidInput for another system.
    """
    require_type("system", model.system, MechanicalSystem, ", for example system=dataset.system")
    if model.noise is not None and not isinstance(model.noise, Noise):
        object.__setattr__(model, "noise", Noise(model.noise))


def checked_rows(joint_names: Sequence[str], dataset: Dataset) -> Dataset:
    """`dataset`, if it has these joints and at least 2 rows. Raises InvalidInput otherwise."""
    remedy = "; the system belongs to the model, as in StructuredGP(system)"
    require_rows("dataset", dataset, joint_names, "the robot", remedy)
    if len(dataset) < 2:
        raise InvalidInput(f"the dataset has {len(dataset)} rows; at least 2 are needed")
    return dataset


def training_rows(joint_names: Sequence[str], dataset: Dataset, points: int | None) -> Dataset:
    """The `points` rows that lie farthest apart in (q, v, u); all of them for None.

    Raises InvalidInput for other joints, fewer than 2 rows and numbers that are out of range.
    """
    checked_rows(joint_names, dataset)
    if points is None:
        return dataset
    points = whole_number("points", points, 2, len(dataset), "the rows of the dataset")
    return dataset if points == len(dataset) else farthest_rows(dataset, points)


def training_windows(
    joint_names: Sequence[str], dataset: Dataset, points: int | None, observe: WindowObservation | str
) -> Windows:
    """The `points` windows of the dataset that lie farthest apart; all of them for None.

    Raises InvalidInput for other joints, names and numbers out of range, DatasetError for logs without windows.
    """
    return observation_of(observe).windows(checked_rows(joint_names, dataset), points)


def noise_of_windows(noise: Noise | None, windows: Windows) -> Noise | None:
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


def resolved_noise(noise: Noise | None, rows: Dataset | Windows) -> Noise:
    """The noise given, else the level that the training rows state, else one that is learned, with a warning.

    It is then learned from `START_SHARE` of the spread of every joint's acceleration; with `Noise(None, learn=True)`
    nothing is warned of.
    """
    if noise is not None and noise.acceleration is not None:
        return noise
    level = rows.noise_level
    noise = noise or Noise()
    if level is not None:
        return replace(noise, acceleration=tuple(float(std) for std in level), from_data=not noise.learn)
    if not noise.learn:
        warnings.warn(
            "the dataset does not state the noise of its accelerations, so it is learned with the other parameters; "
            "give `noise` if it is known",
            DataWarning,
            stacklevel=2,
        )
    return replace(noise, acceleration=_start_of_noise(rows), learn=True)


def _start_of_noise(rows: Dataset | Windows) -> tuple[float, ...]:
    """Where the search for the noise of every joint begins, in units of its acceleration."""
    spread = (rows.observed if isinstance(rows, Windows) else rows.a).std(axis=0)
    largest = float(spread.max())
    if not largest > 0.0:
        raise InvalidInput("the acceleration of every joint is constant, so its noise cannot be learned; give `noise`")
    return tuple(float(START_SHARE * max(std, QUIET * largest)) for std in spread)


def check_search_numbers(restarts: int, seed: int) -> None:
    """Raises InvalidInput for numbers that are out of range."""
    whole_number("restarts", restarts, 1, MOST_RESTARTS, "the most that one search runs")
    whole_number("seed", seed, 0)


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


def described_rows(rows: Dataset | Windows, dataset: Dataset) -> dict[str, Any]:
    """What the settings of a fit hold about its training rows and where they come from, as plain JSON values."""
    return {
        "points": len(rows),
        "rows_available": len(dataset),
        "data": {"metadata": dict(dataset.metadata), "episodes": list(dataset.episodes)},
    }
