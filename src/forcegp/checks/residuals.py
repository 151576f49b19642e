"""What the torques that a robot leaves depend on: positions, waves over them, and loads that are held at times."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from forcegp.checks.causes import NUMBER, Candidate, number
from forcegp.checks.check_input import CheckInput
from forcegp.checks.torques import Comparison, in_motion, left_of, solved
from forcegp.data import Dataset
from forcegp.data.delay import rate_of_waves, waves
from forcegp.data.views import runs
from forcegp.doubts import listed
from forcegp.evidence import motion_residuals
from forcegp.model import Model

KNOTS, BLOCKS = 8, 10  # of position, evenly over the rows; of time, each of which is told by the others
ASKED = 0.6  # of what is left of a torque, below which a function of position leaves it
HEAVIER, TURNS = (1.25, 3.0), 8  # times a load that is held all the time, where one is sought that is not; rounds
UNSURE, ROBUST = 10.0, 4.0  # nats that each change must explain, or another time of it may cost; most of one row
LEAST = 1e-3  # of the torque's own power, which is worth another law


def pushed_where_they_are(rows: Dataset, model: Model, *, by_all: bool = False) -> tuple[str, ...]:
    """Joints whose torque the model misses by a function of their position, as of springs; `by_all` of every one."""
    left, found = motion_residuals(rows, model)[0], list[str]()
    for name, q, u, missed in zip(rows.joint_names, rows.q.T, rows.u.T, (left - left.mean(axis=0)).T, strict=False):
        knots = np.unique(np.quantile(q, np.linspace(0.0, 1.0, KNOTS)))
        hats = np.stack([np.interp(q, knots, each) for each in np.eye(len(knots))], axis=1)
        power = float(np.square(missed).sum())
        if not power > LEAST * len(u) * float(u.var()) > 0.0:  # passive joints have rounding
            continue
        stays = left_by_positions(rows.q, hats[:, :0], missed)[1] * power if by_all else _left(hats, missed)
        found += [name] * (stays < ASKED * power)
    return tuple(found)


def cogging(now: Comparison, inputs: CheckInput, bad: np.ndarray) -> Iterator[Candidate]:
    """One wave over the position of every joint that fits badly, where it explains most of what is left."""
    rows, more, sizes = now.rows, np.zeros_like(now.rows.u), dict[int, tuple[float, float]]()
    for joint in np.flatnonzero(bad).tolist():
        q, moves = rows.q[:, joint], in_motion(rows)[:, joint]  # a few places of rest would fit a fine wave
        basis = np.linalg.qr(now.friction[moves, joint])[0]
        if rate := rate_of_waves(q[moves], (rows.u - now.tau)[moves, joint], basis):
            columns = waves(q, rate)[:, None] * (np.arange(rows.nv) == joint)[:, None]
            found = solved(now, columns)
            if found is not None:
                more += columns @ found
                sizes[joint] = float(np.hypot(*found)), 2.0 * np.pi / rate
    if not sizes:
        return
    units = inputs.unit_of_each("u"), inputs.unit_of_each("q")
    each = [f"{a:.3g} {units[0][k]} every {w:.3g} {units[1][k]} of {inputs.names[k]}" for k, (a, w) in sizes.items()]
    text = f"torques repeat over equal ways: {listed(each)}, as of magnets of a motor, or of teeth of a gear"
    do = "Learn it beside the robot: forcegp score LOG.h5 --forces identified,gp:joint:inputs=q --out scores."
    size, way = (list(values) for values in zip(*sizes.values(), strict=True))
    told = {"joints": tuple(sizes), "numbers": {"size": size, "way": way}, "do": do}
    yield number("cogging", text, 0, 0.0, 1.5 * NUMBER * len(sizes), **told), replace(now, more=now.more + more)


def left_by_positions(
    q: Float[np.ndarray, "rows nq"], columns: Float[np.ndarray, "rows k"], u: Float[np.ndarray, " rows"]
) -> tuple[float, float]:
    """Shares of a torque that these columns leave, and the same with products of two positions, which pull anywhere."""
    x = q[:, np.ptp(q, axis=0) > 0.0]
    x, ones = (x - x.mean(axis=0)) / x.std(axis=0), np.ones((len(u), 1))
    alone = np.concatenate([columns, ones], axis=1)
    beside = np.concatenate([alone, x, *(x[:, [k]] * x[:, k:] for k in range(x.shape[1]))], axis=1)
    power = float(np.square(u - u.mean()).sum())
    return _left(alone, u) / power, _left(beside, u) / power


def _left(columns: Float[np.ndarray, "rows k"], values: Float[np.ndarray, " rows"]) -> float:
    """Of the power of values, what linear functions leave of every block of time by the others."""
    left = 0.0
    for part in np.array_split(np.arange(len(values)), BLOCKS):
        others = np.setdiff1d(np.arange(len(values)), part)
        number = np.linalg.lstsq(columns[others], values[others], rcond=1e-6)[0]
        left += float(np.square(values[part] - columns[part] @ number).sum())
    return left


def loads(
    now: Comparison, inputs: CheckInput, columns: Float[np.ndarray, "rows nv k"]
) -> Iterator[tuple[str, Float[np.ndarray, "rows nv k"], float, dict[str, Any]]]:
    """What a load needs that is always held, then one that is taken up and put down where that leaves least.

    The latter is sought from the load that some of the rows show.
    """
    yield ": it holds something", columns, 2.5 * NUMBER, {}
    if len(now.rows.episodes) > 1 or not inputs.log.time_ordered:
        return
    own, share, tried = now.rows.u - now.tau, np.linspace(0.0, 1.0, len(now.rows)), list[tuple[float, Any, Any]]()
    for (first, last), times in product(((0.0, 1.0), (0.0, 0.5), (0.5, 1.0)), HEAVIER):
        held = before = (share >= first) & (share <= last)
        if (number := solved(now, held[:, None, None] * columns)) is None or number[0] <= 0.0:
            continue
        there, load, nats = held[:, None] * (columns @ number), columns @ (times * number), share
        for _ in range(TURNS):
            none = now.beside_friction((own - there)[..., None])[..., 0].T + there
            more = np.square(none - load) - np.square(none)
            nats = (0.5 * more / ((none - there).var(axis=0) + 1e-300)).sum(axis=1)  # that a load costs in each row
            before, held = held, two_levels(nats.clip(-ROBUST, ROBUST), UNSURE)
            number = solved(now, held[:, None, None] * columns)
            if (held == before).all() or number is None or number[0] <= 0.0:
                break
            load = columns @ number
            there = held[:, None] * load
        if (held == before).all() and held.any() and not held.all():
            left = left_of(now, np.stack([now.rows.u, now.tau + there]), np.ones((1, 1)))
            tried.append((float(left[0]), held, nats))
    if not tried:
        return
    _, held, nats = min(tried, key=lambda each: each[0])
    at, (begin, end), count = now.given.time, inputs.log.time[[0, -1]].tolist(), len(held)
    turned, changes = np.where(held, -nats, nats), np.flatnonzero(np.diff(held)) + 1
    when = f" in {len(runs(held))} stretches of time: it takes up a load and puts it down"
    x, *others = (float(at[k - 1 : k + 1].mean()) for k in changes)
    if not others:
        when = f" until {x:.4g} s: it lets go of a load" if held[0] else f" from {x:.4g} s on: it takes up a load"
    elif len(others) == 1 and not held[0]:
        when = f" from {x:.4g} to {others[0]:.4g} s: it takes up a load and puts it down, or something pulls like one"
    smeared, spans = 1.5 / inputs.compared_cutoff, list[float]()
    for a, b in runs(held == (2 * held.sum() <= count)):  # and as far as it may reach
        a -= int(np.argmax(np.append(np.cumsum(turned[:a][::-1]), np.inf) >= UNSURE))
        b += int(np.argmax(np.append(np.cumsum(turned[b:]), np.inf) >= UNSURE))
        spans += [float(at[a - 1]) - smeared if a else begin, float(at[b]) + smeared if b < count else end]
    told: dict[str, Any] = {"seconds": np.maximum.accumulate(spans).tolist()}
    out = ",".join(f"{x:.2f}" for x in told["seconds"])
    told["do"] = f"Leave the shorter part out by forcegp import LOG --without {out}, as forcegp auto does."
    yield when, held[:, None, None] * columns, (3.25 + 0.25 * len(changes)) * NUMBER, told


def two_levels(cost: Float[np.ndarray, " rows"], change: float) -> Bool[np.ndarray, " rows"]:
    """Which of successive rows to take, so that their costs and those of each change are least (Viterbi 1967)."""
    off, on, moved, found = 0.0, 0.0, list[tuple[bool, bool]](), list[bool]()
    for each in cost.tolist():
        moved.append((on + change < off, off + change < on))
        off, on = min(off, on + change), min(on, off + change) + each
    taken = on < off
    for from_on, from_off in reversed(moved):
        found.append(taken)
        taken = not from_off if taken else from_on
    return np.array(found[::-1])
