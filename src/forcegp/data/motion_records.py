"""`RecordedMotions`: stretches of a recording, with the time steps between their rows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from forcegp.data.dataset import Dataset
from forcegp.errors import InvalidInput

EVEN_STEPS = 1e-3
"""Time steps of a recording count as equal within this fraction."""


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
    Raises InvalidInput for rows that do not exist or lie too near to the end of their episode, for steps of time that
    are not equal, and for a length of less than one step.
    """
    if not dataset.time_ordered:
        raise InvalidInput("the rows of the dataset are not in the order of time; give a whole recording.")
    dt = _time_step(dataset)
    if not (np.isfinite(seconds) and seconds > 0 and round(seconds / dt) >= 1):
        raise InvalidInput(f"the length is {seconds} s; it must be at least one step of the recording, {dt:.4g} s.")
    steps = round(seconds / dt)
    rows = len(dataset)
    # A motion may begin where the row T later belongs to the same episode; the rows of an episode are consecutive.
    last_of_episode = np.append(np.flatnonzero(np.diff(dataset.episode) != 0), rows - 1)
    last = last_of_episode[np.searchsorted(last_of_episode, np.arange(rows))]
    latest = last - steps
    possible = np.flatnonzero(np.arange(rows) <= latest)
    if not possible.size:
        longest = np.unique(dataset.episode, return_counts=True)[1].max() - 1
        raise InvalidInput(
            f"no episode lasts {steps * dt:.4g} s: the longest has {dt * longest:.4g} s; ask for fewer seconds."
        )
    before = _uneven_steps(dataset, dt)
    if isinstance(starts, int):
        if starts < 1:
            raise InvalidInput(f"the number of starts is {starts}; it must be at least 1.")
        whole = possible[before[possible + steps] == before[possible]]
        possible = whole if whole.size else possible  # which is refused then
        chosen = possible[np.unique(np.linspace(0, len(possible) - 1, starts).round().astype(int))]
    else:
        chosen = np.asarray(starts, dtype=int)
        for row in chosen:
            if not 0 <= row < rows:
                raise InvalidInput(f"row {row} does not exist; the dataset has rows 0 to {rows - 1}.")
            if row > latest[row]:
                left = (last[row] - row) * dt
                raise InvalidInput(
                    f"only {left:.4g} s are left from row {row} to the end of its episode, {steps * dt:.4g} s are "
                    f"needed; start at row {latest[row]} or before, or ask for fewer seconds."
                    if latest[row] >= 0
                    else f"only {left:.4g} s are left from row {row} on, {steps * dt:.4g} s are needed; ask for fewer."
                )
    for row in chosen[before[chosen + steps] != before[chosen]][:1]:
        pauses = np.diff(dataset.time[row : row + steps + 1])
        worst = int(np.abs(pauses - dt).argmax())
        raise InvalidInput(
            f"the time steps are uneven: {pauses[worst]:.6g} s after row {row + worst}, {dt:.6g} s elsewhere; resample "
            "the recording to equal steps, or start where there is no gap."
        )
    index = chosen[:, None] + np.arange(steps + 1)
    return RecordedMotions(
        tuple(int(row) for row in chosen), dt, dataset.q[index], dataset.v[index], dataset.u[index[:, :-1]]
    )


def all_motions(dataset: Dataset, seconds: float, longest_step: float) -> tuple[RecordedMotions, int]:
    """The recording cut into stretches of that length, and of how many of its rows a step of `longest_step` s may be.

    Stretches with a gap are left out; their length is a multiple of the steps. Raises InvalidInput where none is left.
    """
    dt = _time_step(dataset)
    stride = max(1, int(longest_step / dt * (1.0 + EVEN_STEPS)))
    steps = stride * max(1, round(seconds / dt / stride))
    before, starts = _uneven_steps(dataset, dt), list[int]()
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


def _time_step(dataset: Dataset) -> float:
    pauses = np.diff(dataset.time)[np.diff(dataset.episode) == 0]
    if not pauses.size:
        raise InvalidInput("every episode has one row only; a rollout is compared with a motion of several rows.")
    return float(np.median(pauses))


def _uneven_steps(dataset: Dataset, dt: float) -> Int[np.ndarray, " rows"]:
    """How many steps before each row are not of dt seconds."""
    return np.concatenate([[0], np.cumsum(np.abs(np.diff(dataset.time) - dt) > EVEN_STEPS * dt)])
