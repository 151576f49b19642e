"""Motions that a model predicts from recorded states under recorded forces, and their errors after a time."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from forcegp.data import Dataset
from forcegp.data.views import EVEN_STEPS, RecordedMotions, recorded_motions
from forcegp.errors import InvalidInput
from forcegp.posterior import Posterior, observing
from forcegp.posterior.rollout import Rollout
from forcegp.robots.manifold import ConfigurationSpace
from forcegp.scores.accuracy import Table
from forcegp.summary import plain

INTERVAL = (0.025, 0.975)

HORIZONS = (0.1, 0.2, 0.5, 1.0)
STARTS = 10
GAP = 1.5
"""A pause of more than this many median steps is a gap, over which no motion goes."""


@dataclass(frozen=True, eq=False)
class HeldOutMotions:
    """The motions to predict, and the horizons [s] that they last for; `notes` report what is missing.

    `stretches` are the rows that each motion is part of, for observers.
    """

    motions: RecordedMotions | None
    horizons: tuple[float, ...]
    notes: tuple[str, ...] = field(default=())
    stretches: tuple[tuple[Dataset, tuple[int, ...]], ...] = ()

    def of(self, posterior: Posterior) -> tuple[Posterior, RecordedMotions]:
        """The posterior, and the motions with what its observers have seen before each of them."""
        assert self.motions is not None, "there are motions"
        pairs = [observing(posterior, rows, whole=True) for rows, _ in self.stretches]
        if all(seen is rows for (_, seen), (rows, _) in zip(pairs, self.stretches, strict=True)):
            return posterior, self.motions
        seconds = self.horizons[-1]
        u = [recorded_motions(seen, at, seconds).u for (_, seen), (_, at) in zip(pairs, self.stretches, strict=True)]
        return pairs[0][0], replace(self.motions, u=np.concatenate(u))


def held_out_motions(
    recording: Dataset,
    held_out: Bool[np.ndarray, " rows"],
    horizons: Sequence[float] | None = None,
    starts: int = STARTS,
) -> HeldOutMotions:
    """`starts` motions in every held-out stretch without gaps that lasts as long as the longest horizon.

    None takes those of `HORIZONS` that some stretch lasts for, with a note on the others, and on time steps that are
    uneven. Raises InvalidInput for horizons that are not positive or that no stretch lasts for, and for no starts.
    """
    wanted = tuple(HORIZONS if horizons is None else horizons)
    if not all(isinstance(h, int | float) and 0.0 < h < np.inf for h in wanted):
        raise InvalidInput(f"horizons are {list(wanted)}; give positive numbers of seconds.")
    wanted = tuple(sorted(set(wanted)))
    if starts < 1:
        raise InvalidInput(f"the number of starts is {starts}; it must be at least 1.")
    if not wanted:
        return HeldOutMotions(None, (), ())
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
        if horizons is not None:
            raise InvalidInput(f"horizons {notes[0]} Give shorter ones.")
    if not possible:
        return HeldOutMotions(None, (), tuple(notes))
    found, parts = [], []
    for rows in stretches:
        if np.ptp(recording.time[rows]) < possible[-1] * (1.0 - EVEN_STEPS):
            continue
        try:
            found.append(recorded_motions(recording.rows(rows), starts, possible[-1]))
            parts.append((recording.rows(rows), found[-1].rows))
        except InvalidInput as error:
            notes.append(f"motions of one stretch were left out: {error}")
    if not found:
        return HeldOutMotions(None, (), tuple(dict.fromkeys(notes)))
    joined = {name: np.concatenate([getattr(each, name) for each in found]) for name in ("q", "v", "u")}
    rows = tuple(row for each in found for row in each.rows)
    motions = RecordedMotions(rows, found[0].dt, **joined)
    return HeldOutMotions(motions, possible, tuple(dict.fromkeys(notes)), tuple(parts))


def motion_scores(
    posterior: Posterior, held_out: HeldOutMotions, integrator: str = "rk4"
) -> tuple[Table, dict[str, Any] | None]:
    """`position after 0.5 s` and the like at every horizon, and what belongs to all of them; None without motions.

    `rmse` over the motions of q in rad or m, of a base in its own axes, of `velocity after ...` in their time
    derivative; `coverage_95` of q where the model has intervals of motions. Motions
    that had diverged by then do not count (None where all had); `diverged` counts them by horizon. `squared` (horizons,
    motions) is the mean over joints of the squared error of q.
    """
    if held_out.motions is None:
        return {}, None
    posterior, motions = held_out.of(posterior)
    rollout = posterior.rollout(
        motions.q[:, 0], motions.v[:, 0], motions.u, motions.dt, integrator=integrator, baumgarte=None
    )
    recorded = torch.as_tensor(motions.q.copy(), device=rollout.q.device)
    off = apart_from(recorded, rollout.q, rollout.space)
    found = {"position": off, "velocity": torch.as_tensor(motions.v.copy(), device=rollout.q.device) - rollout.v}
    inside = inside_interval(rollout, recorded)
    table: Table = {}
    facts: dict[str, Any] = {"horizons": list(held_out.horizons), "motions": len(motions.q), "integrator": integrator}
    facts |= {"dt": motions.dt, "diverged": [], "squared": []}
    for horizon in held_out.horizons:
        row = round(horizon / motions.dt)
        lasting = torch.isfinite(off[:, row]).all(-1)
        for name, errors in found.items():
            here = errors[lasting, row].square().mean(0).sqrt()
            table[f"{name} after {horizon:g} s"] = {"rmse": plain(here.cpu().numpy())}
        if inside is not None:
            table[f"position after {horizon:g} s"]["coverage_95"] = plain(inside[lasting, row].mean(0).cpu().numpy())
        facts["diverged"].append(int((~lasting).sum()))
        facts["squared"].append(plain(off[:, row].square().mean(-1).cpu().numpy()))
    return table, facts


def apart_from(q0: Tensor, q1: Tensor, space: ConfigurationSpace) -> Float[Tensor, "*batch nv"]:
    """The way from q0 to q1: their difference, on the manifold where a base moves; NaN where one of them is."""
    if space.is_vector_space:
        return q1 - q0
    lost = torch.isnan(q0).any(-1) | torch.isnan(q1).any(-1)
    neutral = space.neutral().to(q1)
    way = space.difference(*(torch.where(lost[..., None], neutral, q) for q in (q0, q1)))
    return torch.where(lost[..., None], torch.nan, way)


def interval_about(rollout: Rollout, q0: Tensor) -> tuple[Float[Tensor, "*batch nv"], Float[Tensor, "*batch nv"]]:
    """Ends of the 95 % interval of q as ways from q0."""
    space = rollout.space
    if space.is_vector_space:
        low, high = rollout.interval()
        return low - q0, high - q0
    if rollout.intervals is None:
        levels = torch.tensor(INTERVAL, dtype=q0.dtype, device=q0.device)
        assert rollout.samples is not None, "without them there is no interval"
        low, high = torch.quantile(apart_from(q0, rollout.samples.q, space), levels, dim=0)
        return low, high
    # what steps from the motion change of the way to it: entries of a step are as if independent
    way, (_, wide) = apart_from(q0, rollout.q, space), rollout.interval()
    half = (space.chart_matrix(way).square() * wide.square()[..., None, :]).sum(-1).sqrt()
    return way - half, way + half


def inside_interval(rollout: Rollout, recorded: Tensor) -> Float[Tensor, "motions rows nv"] | None:
    """Whether the recorded q lies in the 95 % interval, NaN after a divergence; None where there is no interval."""
    if rollout.samples is None and rollout.intervals is None:
        return None
    low, high = interval_about(rollout, rollout.q)
    off = apart_from(rollout.q, recorded, rollout.space)
    return torch.where(torch.isnan(high - low), torch.nan, ((low <= off) & (off <= high)).to(off))


def _step(recording: Dataset) -> float:
    pauses = np.diff(recording.time)[np.diff(recording.episode) == 0]
    return float(np.median(pauses)) if pauses.size else float("inf")


def _stretches(recording: Dataset, held_out: Bool[np.ndarray, " rows"]) -> list[np.ndarray]:
    """Numbers of held-out rows that follow each other in one episode without a gap."""
    rows = np.flatnonzero(held_out)
    apart = (np.diff(rows) > 1) | (np.diff(recording.episode[rows]) != 0)
    apart |= np.diff(recording.time[rows]) > GAP * _step(recording)
    return [part for part in np.split(rows, np.flatnonzero(apart) + 1) if len(part) > 1]
