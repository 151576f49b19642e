"""How far predictions of whole motions are off after 0.1 s, 0.2 s, ...: k-step prediction from recorded states.

A motion begins at a recorded state of a held-out stretch, and the mean of the model is integrated under the recorded
forces u, each held from its row to the next. Nothing is corrected on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.evaluation.recorded_segments import EVEN_STEPS, RecordedMotions, recorded_motions
from forcegp.models import Posterior
from forcegp.validation.scores import plain

HORIZONS = (0.1, 0.2, 0.5, 1.0)
STARTS = 5
GAP = 1.5
"""A pause of more than this many median steps is a gap, over which no motion goes."""


@dataclass(frozen=True, eq=False)
class HeldOutMotions:
    """The motions to predict, and the horizons [s] that they last for; `notes` report what is missing."""

    motions: RecordedMotions | None
    horizons: tuple[float, ...]
    notes: tuple[str, ...] = field(default=())


def held_out_motions(
    recording: Dataset, held_out: Bool[np.ndarray, " rows"], horizons: Sequence[float] = HORIZONS, starts: int = STARTS
) -> HeldOutMotions:
    """`starts` motions in every held-out stretch without gaps that lasts as long as the longest horizon.

    Horizons that no stretch lasts for are left out with a note, and so is everything where time steps are uneven.
    Raises InvalidInput for horizons that are not positive and for no starts.
    """
    wanted = tuple(sorted(set(horizons)))
    if not wanted or not all(np.isfinite(h) and h > 0.0 for h in wanted):
        raise InvalidInput(f"horizons are {list(horizons)}; give one or more positive numbers of seconds.")
    if starts < 1:
        raise InvalidInput(f"the number of starts is {starts}; it must be at least 1.")
    if not recording.time_ordered:
        return HeldOutMotions(None, (), ("no motion was predicted: the rows are not in the order of time.",))
    stretches = _stretches(recording, held_out)
    longest = max((float(np.ptp(recording.time[rows])) for rows in stretches), default=0.0)
    step = _step(recording)
    possible = tuple(h for h in wanted if step <= h <= longest * (1.0 + EVEN_STEPS))
    notes = []
    if len(possible) < len(wanted):
        left_out = ", ".join(f"{h:g} s" for h in wanted if h not in possible)
        notes.append(f"not predicted: {left_out}; held-out stretches last {longest:.3g} s at most, steps {step:.3g} s.")
    if not possible:
        return HeldOutMotions(None, (), tuple(notes))
    found = []
    for rows in stretches:
        if np.ptp(recording.time[rows]) < possible[-1] * (1.0 - EVEN_STEPS):
            continue
        try:
            found.append(recorded_motions(recording.rows(rows), starts, possible[-1]))
        except InvalidInput as error:
            notes.append(f"motions of one stretch were left out: {error}")
    if not found:
        return HeldOutMotions(None, (), tuple(dict.fromkeys(notes)))
    joined = {name: np.concatenate([getattr(each, name) for each in found]) for name in ("q", "v", "u")}
    rows = tuple(row for each in found for row in each.rows)
    return HeldOutMotions(RecordedMotions(rows, found[0].dt, **joined), possible, tuple(dict.fromkeys(notes)))


def motion_scores(posterior: Posterior, held_out: HeldOutMotions, integrator: str = "rk4") -> dict[str, Any] | None:
    """Errors of q at every horizon [s], as plain JSON values; None where there are no motions.

    `rms_per_joint` (horizons, nv) is the root mean square over the motions of |q - q_recorded|, `rms` over joints as
    well, in rad or m; both over the motions that had not diverged by then (None where all had), and `diverged`
    (horizons,) counts the others.
    """
    motions = held_out.motions
    if motions is None:
        return None
    rollout = posterior.rollout(
        motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt, integrator=integrator, baumgarte=None
    )
    squared = np.square(rollout.q.cpu().numpy() - motions.q)
    scores: dict[str, Any] = {"horizons": list(held_out.horizons), "motions": len(motions.q), "integrator": integrator}
    scores |= {"dt": motions.dt, "rms_per_joint": [], "rms": [], "diverged": []}
    for horizon in held_out.horizons:
        here = squared[:, round(horizon / motions.dt)]
        lasting = np.isfinite(here).all(axis=-1)
        per_joint = _root_mean(here[lasting])
        scores["rms_per_joint"].append(plain(per_joint))
        scores["rms"] += plain(np.sqrt(np.square(per_joint).mean(keepdims=True)))
        scores["diverged"].append(int((~lasting).sum()))
    return scores


def _root_mean(squared: Float[np.ndarray, "motions nv"]) -> Float[np.ndarray, " nv"]:
    return np.sqrt(squared.mean(axis=0)) if len(squared) else np.full(squared.shape[-1], np.nan)


def _step(recording: Dataset) -> float:
    pauses = np.diff(recording.time)[np.diff(recording.episode) == 0]
    return float(np.median(pauses)) if pauses.size else float("inf")


def _stretches(recording: Dataset, held_out: Bool[np.ndarray, " rows"]) -> list[np.ndarray]:
    """Numbers of held-out rows that follow each other in one episode without a gap."""
    rows = np.flatnonzero(held_out)
    apart = (np.diff(rows) > 1) | (np.diff(recording.episode[rows]) != 0)
    apart |= np.diff(recording.time[rows]) > GAP * _step(recording)
    return [part for part in np.split(rows, np.flatnonzero(apart) + 1) if len(part) > 1]
