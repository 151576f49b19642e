"""Steps of time of a log: differences, other times, and what is done episode by episode."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from forcegp.data.configurations import actuators, continuous, rates, space_of, through
from forcegp.data.dataset import Dataset
from forcegp.data.dataset_fields import unit_of_each
from forcegp.errors import DatasetError, InvalidInput
from forcegp.robots.manifold import ConfigurationSpace

JITTER = 0.01
"""Largest deviation of a time step from the median step, relative to it, that still counts as uniform sampling."""


def differentiate(
    values: Float[np.ndarray, "rows columns"], time: Float[np.ndarray, " rows"], space: ConfigurationSpace | None = None
) -> np.ndarray:
    """Central differences, second order also at both ends and for unequal steps (three-point Lagrange formulas).

    Units: those of `values` per second. Positions of a `space` in which they do not add up give velocities (rows, nv)
    in body axes. Raises DatasetError for fewer than three rows or time that does not increase.
    """
    if len(values) < 3:
        raise DatasetError(f"{len(values)} rows are too few to differentiate; at least 3 are needed.")
    if len(time) != len(values) or not (np.diff(time) > 0).all():
        raise DatasetError(f"time must have {len(values)} entries that increase strictly.")
    if space is not None and not space.is_vector_space:
        return rates(space, values, time)
    return np.gradient(values, time, axis=0, edge_order=2)


def uniform_step(time: Float[np.ndarray, " rows"], name: str = "this recording") -> float:
    """The sampling interval [s]. Raises DatasetError if steps differ by more than `JITTER` (1 %) from their median."""
    if len(time) < 2:
        raise DatasetError(f"{name} has {len(time)} row; at least 2 are needed.")
    steps = np.diff(time)
    median = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - median)))
    if median <= 0 or abs(steps[worst] - median) > JITTER * median:
        raise DatasetError(
            f"{name} is not sampled uniformly: the step after row {worst} is {steps[worst]:.6g} s, the median "
            f"{median:.6g} s. Resample it first (forcegp.data.resample)."
        )
    return float((time[-1] - time[0]) / (len(time) - 1))


def differentiated(dataset: Dataset, source: Literal["q", "v"] = "v") -> Dataset:
    """The Dataset with `a` computed from `v` by central differences, or `v` and `a` from `q`, within each episode.

    Differences amplify noise: filter `source` first (`low_pass`). `noise_std` becomes None. `truth` is dropped where
    `v` changes: the equation of motion would no longer hold with it. Raises DatasetError for rows that are not in
    order of time, episodes of fewer than 3 rows and positions that jump by a turn; InvalidInput for another source.
    """
    if source not in ("q", "v"):
        raise InvalidInput(f"source is {source!r}; allowed: 'q' (gives v and a) or 'v' (gives a).")

    def derivatives(rows: Dataset, label: str) -> dict[str, np.ndarray]:
        if source == "v":
            return {"a": differentiate(rows.v, rows.time)}
        require_no_turns(rows, label)
        velocity = differentiate(rows.q, rows.time, space_of(rows))
        return {"v": velocity, "a": differentiate(velocity, rows.time)}

    truth = dataset.truth if source == "v" else {}
    return replace(dataset, **by_episode(dataset, derivatives), truth=truth, noise_std=None)


def resample(dataset: Dataset, step: float) -> Dataset:
    """The Dataset at uniform times, `step` [s] apart, by a cubic spline through each signal of each episode.

    Switches of contacts are those of the row before.
    Filter first (`low_pass`) when going to a longer step: a spline does not remove what the new rate cannot carry.
    `truth` and `noise_std` are dropped, since interpolation makes neither. Raises InvalidInput for a step <= 0 or
    longer than an episode, DatasetError for rows that are not in order of time or positions that jump by a turn.
    """
    if not (np.isfinite(step) and step > 0):
        raise InvalidInput(f"step is {step} s; it must be > 0.")
    parts: list[dict[str, np.ndarray]] = []
    for number, rows, label in episodes_in_order(dataset):
        require_no_turns(rows, label)
        duration = rows.time[-1] - rows.time[0]
        count = int(np.floor(duration / step * (1 + 1e-12))) + 1
        if count < 2:
            raise InvalidInput(f"step is {step} s, longer than {label} ({duration:.6g} s).")
        time = np.minimum(rows.time[0] + step * np.arange(count), rows.time[-1])

        def spline(values: np.ndarray, own: np.ndarray = rows.time, time: np.ndarray = time) -> np.ndarray:
            return CubicSpline(own, values, axis=0)(time)

        signals = {name: spline(getattr(rows, name)) for name in ("v", "u", "a")}
        signals["q"] = through(space_of(rows), rows.q, spline)
        before = np.searchsorted(rows.time, time * (1 + 1e-12), side="right") - 1
        signals["u"][:, actuators(rows) :] = rows.u[before, actuators(rows) :]
        parts.append({**signals, "time": time, "episode": np.full(count, number)})
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return replace(dataset, **joined, truth={}, noise_std=None)


def episodes_in_order(dataset: Dataset) -> list[tuple[int, Dataset, str]]:
    """Number, rows and name for messages of every episode. Raises DatasetError for rows not in order of time."""
    if not dataset.time_ordered:
        raise DatasetError(
            "the rows are not in order of time (a sample of rows?); filter the whole recording, then sample."
        )
    return [(number, dataset.select_episodes([number]), f"episode {number}") for number in dataset.episodes]


def sums_before(
    values: Float[np.ndarray, "rows k"], time: Float[np.ndarray, " rows"], seconds: float
) -> Float[np.ndarray, "rows k"]:
    """Sums of the rows before each, with weights exp(-age / seconds); zero for the first."""
    sums = np.zeros_like(values)
    keep = np.exp(-np.diff(time) / seconds)
    for row in range(1, len(values)):
        sums[row] = keep[row - 1] * (sums[row - 1] + values[row - 1])
    return sums


def by_episode(dataset: Dataset, change: Callable[[Dataset, str], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Apply `change` to each episode and put its rows back where they came from."""
    result: dict[str, np.ndarray] = {}
    for number, rows, label in episodes_in_order(dataset):
        try:
            changed = change(rows, label)
        except DatasetError as error:
            raise error if label in str(error) else DatasetError(f"{label}: {error}") from error
        for name, values in changed.items():
            result.setdefault(name, np.empty_like(values, shape=(len(dataset), *values.shape[1:])))
            result[name][dataset.episode == number] = values
    return result


def require_no_turns(rows: Dataset, label: str) -> None:
    """A position that wraps at pi jumps by a turn; every derivative and filter would take that for motion."""
    space = space_of(rows)
    continuous(space, rows.q)
    units = unit_of_each("q", rows.units["q"], rows.nv)
    angular = [units[k] == "rad" for k in space.single_rows]
    jumps = np.abs(np.diff(space.singles(torch.from_numpy(rows.q.copy())).numpy()[:, angular], axis=0)) > np.pi
    if jumps.any():
        row, column = np.argwhere(jumps)[0]
        joint = rows.joint_names[np.asarray(space.single_rows)[angular][column]]
        raise DatasetError(
            f"{label}: q of joint {joint!r} jumps by more than pi after row {row}; the angle wraps. "
            "Unwrap it first (np.unwrap(q, axis=0))."
        )
