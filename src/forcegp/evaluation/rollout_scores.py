"""`RolloutErrors`: how far rollouts are from what was recorded, over time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.mechanics import MechanicalSystem
from forcegp.models.rollout import Rollout

EVEN_STEPS = 1e-3
"""Time steps of a recording count as equal within this fraction."""


@dataclass(frozen=True, eq=False)
class RecordedMotions:
    """B recorded motions of T steps of `dt` seconds; in row k of a motion u[k] acts until row k + 1.

    q, v: (B, T+1, nv) and u: (B, T, nv) in the units of the Dataset; `rows` where each begins in it.
    """

    rows: tuple[int, ...]
    dt: float
    q: Float[np.ndarray, "motions rows nv"]
    v: Float[np.ndarray, "motions rows nv"]
    u: Float[np.ndarray, "motions steps nv"]

    @property
    def time(self) -> Float[np.ndarray, " rows"]:
        """Seconds since the beginning of each motion."""
        return self.dt * np.arange(self.q.shape[1])


def recorded_motions(dataset: Dataset, starts: int | Sequence[int], seconds: float) -> RecordedMotions:
    """The motions of that length that begin at the given rows, or at so many rows spread evenly over the recording.

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
        raise InvalidInput(
            f"no episode lasts {steps * dt:.4g} s: the longest has {dt * _longest(dataset):.4g} s; ask for fewer "
            "seconds."
        )
    if isinstance(starts, int):
        if starts < 1:
            raise InvalidInput(f"the number of starts is {starts}; it must be at least 1.")
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
    _require_even(dataset, chosen, steps, dt)
    index = chosen[:, None] + np.arange(steps + 1)
    return RecordedMotions(
        tuple(int(row) for row in chosen), dt, dataset.q[index], dataset.v[index], dataset.u[index[:, :-1]]
    )


def _time_step(dataset: Dataset) -> float:
    pauses = np.diff(dataset.time)[np.diff(dataset.episode) == 0]
    if not pauses.size:
        raise InvalidInput("every episode has one row only; a rollout is compared with a motion of several rows.")
    return float(np.median(pauses))


def _longest(dataset: Dataset) -> int:
    """Steps of the longest episode."""
    return int(np.unique(dataset.episode, return_counts=True)[1].max()) - 1


def _require_even(dataset: Dataset, starts: np.ndarray, steps: int, dt: float) -> None:
    for row in starts:
        pauses = np.diff(dataset.time[row : row + steps + 1])
        worst = int(np.abs(pauses - dt).argmax())
        if abs(pauses[worst] - dt) > EVEN_STEPS * dt:
            raise InvalidInput(
                f"the time steps are uneven: {pauses[worst]:.6g} s after row {row + worst}, {dt:.6g} s elsewhere; "
                "resample the recording to equal steps, or start where there is no gap."
            )


INTERVAL = (0.025, 0.975)


@dataclass(frozen=True, eq=False)
class RolloutErrors:
    """Errors of B rollouts against recorded motions; NaN where a rollout had diverged.

    joint: (B, T+1, nv) |q - q_recorded| in rad or m.
    tool: (B, T+1) largest distance of a contact point from the recorded one in m; None without contacts.
    constraint: (B, T+1) largest |c(q)| of a contact in m; None without contacts. recorded_constraint: that of the
        recording.
    spread: (B, T+1, nv) half the width of the 95 % interval of the sampled q; None without samples.
    inside: (B, T+1, nv) whether the recorded q lies in that interval (NaN where there is none); None without samples.
    diverged_at: (B,) see `Rollout`.
    """

    time: Float[np.ndarray, " rows"]
    joint: Float[np.ndarray, "motions rows nv"]
    tool: Float[np.ndarray, "motions rows"] | None
    constraint: Float[np.ndarray, "motions rows"] | None
    recorded_constraint: Float[np.ndarray, "motions rows"] | None
    spread: Float[np.ndarray, "motions rows nv"] | None
    inside: Float[np.ndarray, "motions rows nv"] | None
    diverged_at: Int[np.ndarray, " motions"]


def rollout_errors(rollout: Rollout, recorded: RecordedMotions, system: MechanicalSystem) -> RolloutErrors:
    """Compare rollouts (B, T+1, nv) with the motions from whose first rows they began."""
    tool = constraint = recorded_constraint = spread = inside = None
    actual = torch.as_tensor(np.array(recorded.q), device=rollout.q.device)
    if system.contacts:
        here, there = (system.robot.kinematics(q) for q in (rollout.q, actual))
        apart = [
            torch.linalg.vector_norm(contact.position(here) - contact.position(there), dim=-1)
            for contact in system.contacts
        ]
        tool = torch.stack(apart).amax(0).cpu().numpy()
        constraint = rollout.constraint.abs().amax(-1).cpu().numpy()
        distances = [contact.distance(there).abs() for contact in system.contacts]
        recorded_constraint = torch.stack(distances).amax(0).cpu().numpy()
    if rollout.samples is not None:
        low, high = rollout.quantiles(INTERVAL, "q").cpu().numpy()
        spread = 0.5 * (high - low)
        inside = np.where(np.isnan(spread), np.nan, (low <= recorded.q) & (recorded.q <= high))
    return RolloutErrors(
        time=rollout.time.cpu().numpy(),
        joint=(rollout.q - actual).abs().cpu().numpy(),
        tool=tool,
        constraint=constraint,
        recorded_constraint=recorded_constraint,
        spread=spread,
        inside=inside,
        diverged_at=rollout.diverged_at.cpu().numpy(),
    )
