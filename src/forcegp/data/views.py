"""Views of a log: rows that follow each other, windows, motions of equal length, and what laws remember at each row."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from forcegp.data.dataset import Dataset
from forcegp.errors import InvalidInput
from forcegp.model import Model

Select = Callable[[Dataset, int], Int[np.ndarray, " chosen"]]
"""Which rows: numbers of at most so many of a log, such as `evenly` and `farthest` give."""

EVEN_STEPS = 1e-3  # Time steps of a recording count as equal within this fraction
LEAP = 0.3  # median step of a position over its standard deviation, from which rows are no motion (random states: 0.95)


def evenly(dataset: Dataset, count: int) -> Int[np.ndarray, " chosen"]:
    """Rows at even distances over the log, the first and the last among them; a `Select`."""
    return np.unique(np.linspace(0, len(dataset) - 1, min(count, len(dataset))).astype(int))


def consecutive(dataset: Dataset) -> Bool[np.ndarray, " rows"]:
    """Whether the next row belongs to the same episode and follows; False for the last row."""
    return np.append(dataset.episode[1:] == dataset.episode[:-1], False)


def move_on(dataset: Dataset) -> bool:
    """Whether rows that follow each other belong to one motion; a sample of rows or of random states leaps about."""
    steps = np.abs(np.diff(dataset.q, axis=0))[consecutive(dataset)[:-1]]
    spread = dataset.q.std(axis=0)
    moving = spread > 0.0
    if not len(steps) or not moving.any():
        return bool(len(steps))
    return bool((np.median(steps, axis=0)[moving] < LEAP * spread[moving]).any())


def runs(marked: Bool[np.ndarray, " rows"]) -> Int[np.ndarray, "runs 2"]:
    """First rows of all runs of True, and the rows after them."""
    return np.flatnonzero(np.diff(marked, prepend=False, append=False)).reshape(-1, 2)


def whole_windows(dataset: Dataset, width: int) -> Int[np.ndarray, " windows"]:
    """First rows of the windows of so many rows that lie within an episode."""
    breaks = np.cumsum(np.insert(~consecutive(dataset), 0, False))
    first = np.arange(max(0, len(dataset) - width + 1))
    return first[breaks[first + width - 1] == breaks[first]]


def window_means(values: Float[np.ndarray, "rows k"], first: np.ndarray, width: int) -> Float[np.ndarray, "windows k"]:
    """Means over `width` rows from each of the `first` on."""
    sums = np.cumsum(np.insert(values, 0, 0.0, axis=0), axis=0)
    return (sums[first + width] - sums[first]) / width


def with_memory(dataset: Dataset, model: Model) -> Dataset:
    """The log with the columns of u that `model.memory` names: one scan over each episode, from where it begins.

    Rows before the first reversal depend on that beginning, which no log tells. Raises InvalidInput for rows that are
    not in order of time, since a sample has no past.
    """
    memory = model.memory
    if not memory.names or dataset.u.shape[1] == len(model.inputs):
        return dataset
    if not dataset.time_ordered:
        raise InvalidInput(
            f"{', '.join(memory.titles)} remembers, and the rows are not in order of time; give the whole log."
        )
    columns = np.zeros((len(dataset), len(memory.names)))
    for episode in dataset.episodes:
        rows = np.flatnonzero(dataset.episode == episode)
        q, time = (torch.as_tensor(np.array(x[rows]), device=model.robot.device) for x in (dataset.q, dataset.time))
        columns[rows] = memory.along(q, time).cpu().numpy()
    first = model.inputs.index(memory.names[0])
    u = np.concatenate([dataset.u[:, :first], columns, dataset.u[:, first:]], axis=1)
    return replace(dataset, u=u, model=model.known)


@dataclass(frozen=True, eq=False)
class RecordedMotions:
    """B recorded motions of T steps of `dt` seconds; in row k of a motion u[k] acts until row k + 1.

    q, v: (B, T+1, nv) and u: (B, T, nv) in the units of the Dataset; `rows` where each begins in it.
    """

    rows: tuple[int, ...]
    dt: float
    q: Float[np.ndarray, "motions rows nq"]
    v: Float[np.ndarray, "motions rows nv"]
    u: Float[np.ndarray, "motions steps nu"]

    @property
    def time(self) -> Float[np.ndarray, " rows"]:
        """Seconds since the beginning of each motion."""
        return self.dt * np.arange(self.q.shape[1])


def recorded_motions(dataset: Dataset, starts: int | Sequence[int], seconds: float) -> RecordedMotions:
    """The motions of that length that begin at the given rows, or at so many rows spread evenly over the recording.

    A number of starts takes motions without a gap, where there are any.
    Raises InvalidInput for rows at which no motion of that length begins, for steps of time that are not equal, and for
    a length of less than one step.
    """
    if not dataset.time_ordered:
        raise InvalidInput("the rows of the dataset are not in the order of time; give a whole recording.")
    dt, before = _even_steps(dataset)
    if not (np.isfinite(seconds) and seconds > 0 and round(seconds / dt) >= 1):
        raise InvalidInput(f"the length is {seconds} s; it must be at least one step of the recording, {dt:.4g} s.")
    steps = round(seconds / dt)
    possible = whole_windows(dataset, steps + 1)
    if not possible.size:
        longest = np.unique(dataset.episode, return_counts=True)[1].max() - 1
        raise InvalidInput(
            f"no episode lasts {steps * dt:.4g} s: the longest has {dt * longest:.4g} s; ask for fewer seconds."
        )
    if isinstance(starts, int):
        if starts < 1:
            raise InvalidInput(f"the number of starts is {starts}; it must be at least 1.")
        whole = possible[before[possible + steps] == before[possible]]
        possible = whole if whole.size else possible  # which is refused then
        chosen = possible[np.unique(np.linspace(0, len(possible) - 1, starts).round().astype(int))]
    else:
        chosen = np.asarray(starts, dtype=int)
        for row in chosen[~np.isin(chosen, possible)][:1]:
            raise InvalidInput(
                f"no motion of {steps * dt:.4g} s begins at row {row} of the {len(dataset)} rows within its episode; "
                "start earlier, or ask for fewer seconds."
            )
    for row in chosen[before[chosen + steps] != before[chosen]][:1]:
        pauses = np.diff(dataset.time[row : row + steps + 1])
        worst = int(np.abs(pauses - dt).argmax())
        raise InvalidInput(
            f"the time steps are uneven: {pauses[worst]:.6g} s after row {row + worst}, {dt:.6g} s elsewhere; resample "
            "the recording to equal steps, or start where there is no gap."
        )
    index = chosen[:, None] + np.arange(steps + 1)
    return RecordedMotions(tuple(chosen.tolist()), dt, dataset.q[index], dataset.v[index], dataset.u[index[:, :-1]])


def all_motions(dataset: Dataset, seconds: float, longest_step: float) -> tuple[RecordedMotions, int]:
    """The recording cut into stretches of that length, and of how many of its rows a step of `longest_step` s may be.

    Stretches with a gap are left out; their length is a multiple of the steps. Raises InvalidInput where none is left.
    """
    dt, before = _even_steps(dataset)
    stride = max(1, int(longest_step / dt * (1.0 + EVEN_STEPS)))
    steps = stride * max(1, round(seconds / dt / stride))
    starts = list[int]()
    for number in dataset.episodes:
        rows = np.flatnonzero(dataset.episode == number)
        firsts = rows[: len(rows) - steps : steps]
        starts += firsts[before[firsts + steps] == before[firsts]].tolist()
    if not starts:
        raise InvalidInput(
            f"no stretch of {steps * dt:.4g} s has equal steps of {dt:.4g} s; give fewer seconds, or resample the "
            "recording (forcegp import does)."
        )
    return recorded_motions(dataset, starts, steps * dt), stride


def _even_steps(dataset: Dataset) -> tuple[float, Int[np.ndarray, " rows"]]:
    """The median step of time [s], and how many steps before each row are not of that length."""
    pauses = np.diff(dataset.time)
    own = pauses[consecutive(dataset)[:-1]]
    if not own.size:
        raise InvalidInput("every episode has one row only; a rollout is compared with a motion of several rows.")
    dt = float(np.median(own))
    return dt, np.concatenate([[0], np.cumsum(np.abs(pauses - dt) > EVEN_STEPS * dt)])
