"""Rows of a signal that do not go with those before and after: drop-outs and spikes."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from forcegp.checks.check_input import EVERY_QUANTITY, QUANTITY, STEPS, CheckInput
from forcegp.data.views import consecutive, resolution
from forcegp.doubts import Doubt, listed, wrong

FAR_OFF = 20.0  # times what is second to it, by which a spike is off the middle of its neighbours
MOST_SPIKES = 5  # of a signal: more are its nature
BACK = 0.4  # of that, by which each neighbour is off the other way: half of it, unlike at a kink or a step


def single_row_doubts(inputs: CheckInput) -> list[Doubt]:
    """Drop-outs, then spikes."""
    return [*_dropped(inputs), *_spikes(inputs)]


def _dropped(inputs: CheckInput) -> Iterator[Doubt]:
    """Rows of a signal that were lost and read 0."""
    lost = {name: rows for name, rows in inputs.dropped.items() if rows.any()}
    if not lost:
        return
    every = np.any(list(lost.values()), axis=0)
    rows = every.any(axis=1)
    first, share = int(np.argmax(rows)), 100.0 * rows.mean()
    yield wrong(
        about="drop-outs",
        what=f"{int(rows.sum())} rows ({share:.2g} %) read exactly 0 between values that are far from 0, in "
        f"{listed(tuple(EVERY_QUANTITY[name] for name in lost))}; the first is row {first} at "
        f"{inputs.log.time[first]:.3f} s.",
        do="They were not measured: leave these rows out, and look at the logger.",
        joints=inputs.named(np.flatnonzero(every.any(axis=0))),
        numbers={"rows": int(rows.sum()), "row": first, "quantities": list(lost)},
    )


def _spikes(inputs: CheckInput) -> Iterator[Doubt]:
    """Single rows in which a signal is far from where it is before and after, as in no other row."""
    log, found, joints = inputs.mended, dict[int, str](), dict[str, None]()
    for name, joint in product("vu" if inputs.jumps.any() else "qvu", range(log.nv if log.time_ordered else 0)):
        x = getattr(log, name)[:, joint]
        for row in _spikes_of(x, consecutive(log)):
            around = f"{x[row]:.4g}, and {x[row - 1]:.4g} and {x[row + 1]:.4g} before and after it"
            found.setdefault(row, f"the {QUANTITY[name]} of {inputs.names[joint]} is {around}")
            joints[inputs.names[joint]] = None
    if not found:
        return
    rows, half = np.array(sorted(found)), 0.5 * float(np.median(np.diff(log.time)))
    places = max(2, 2 - int(np.floor(np.log10(half))))
    out = ",".join(f"{end:.{places}f}" for t in log.time[rows] for end in (t - half, t + half))
    first = int(rows[0])
    more = f", as in {len(rows) - 1} more" if len(rows) > 1 else ""
    yield wrong(
        about="spike",
        what=f"{found[first]}: a single wrong value, in row {first} at {log.time[first]:.3f} s{more}.",
        do=f"Leave it out, by forcegp import --without {out}.",
        joints=tuple(joints),
        numbers={"rows": rows.tolist()},
    )


def _spikes_of(x: np.ndarray, follows: np.ndarray) -> list[int]:
    """The rows of those of one signal."""
    tops, found = list[int](), list[int]()
    if len(x) < 5 or not np.ptp(x) > 0.0:
        return found
    off = np.zeros(len(x))
    off[1:-1] = np.where(follows[:-2] & follows[1:-1], np.abs(x[1:-1] - 0.5 * (x[2:] + x[:-2])), 0.0)
    rest, least = off.copy(), STEPS * resolution(x)
    for _ in range(MOST_SPIKES):
        top = int(np.argmax(rest))
        tops.append(top)
        rest[max(top - 1, 0) : top + 2] = 0.0
        if off[top] > max(FAR_OFF * rest.max(), least) and rest.any():
            found = list(tops)
    return [top for top in found if min(off[max(top - 1, 0)], off[min(top + 1, len(x) - 1)]) > BACK * off[top]]
