"""Angles of joints that step by more than half a turn: those that wrap are continued, those that count turns stay."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

TURN = 2.0 * np.pi
NEAR = 0.25 * TURN
"""How far a step may be from that of the velocity, or from one of its neighbours."""
PAUSE = 10.0  # median steps of time, after which a step shows nothing


def turns_to_add(
    q: Float[np.ndarray, " rows"],
    time: Float[np.ndarray, " rows"],
    v: Float[np.ndarray, " rows"] | None,
    begins: Int[np.ndarray, " episodes"],
) -> tuple[Float[np.ndarray, " rows"], Int[np.ndarray, " open"]]:
    """Whole turns that continue q [rad] where it wraps, and the rows at which nothing shows whether it does.

    A step beyond half a turn is a wrap, or motion between two rows. v [rad/s] decides where each of these steps is
    within a quarter turn of it, read in one of the two ways. Otherwise the reading holds in which all of them are so
    near the step before or behind; where both are, the angle counts turns if it covers more than one.
    """
    steps, times = (np.diff(x, prepend=x[:1]) for x in (q, time))
    steps[begins] = times[begins] = 0.0
    turns = np.where(np.abs(steps) > np.pi, -np.round(steps / TURN), 0.0)
    readings = np.stack([steps, steps + TURN * turns])  # it counts turns, or it wraps
    beyond = np.flatnonzero(turns)
    pause = times > PAUSE * np.median(times)
    shown = beyond[~pause[beyond]]
    if v is not None:
        moved = times * 0.5 * (v + np.append(v[:1], v[:-1]))
        near = np.abs(readings - moved)[:, shown] < NEAR
        if near.any(axis=0).all() and moved[shown].any():
            turns[shown[near[0]]] = 0.0
            turns[pause] *= near[1].any()
            return np.cumsum(turns), beyond[:0]
    others = np.abs(np.diff(readings, axis=1))
    near = np.minimum(others[:, shown - 1], others[:, np.minimum(shown, len(q) - 2)]) < NEAR
    counts, wraps = (len(shown) > 0 and bool(each.all()) for each in near)
    if counts and (not wraps or np.ptp(q) > TURN):
        return np.zeros(len(q)), beyond[:0]
    if wraps and not counts:
        return np.cumsum(turns), beyond[:0]
    odd = shown[~near[int(near[1].sum() > near[0].sum())]]
    return np.zeros(len(q)), odd if len(odd) else beyond
