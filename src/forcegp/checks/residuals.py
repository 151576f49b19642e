"""What the torques that a robot leaves depend on: positions, and waves over them."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from forcegp.checks.causes import NUMBER, Candidate, number
from forcegp.checks.check_input import CheckInput
from forcegp.checks.torques import Comparison, in_motion, solved
from forcegp.data import Dataset
from forcegp.data.ripple import rate_of_waves, waves
from forcegp.doubts import listed
from forcegp.evidence import motion_residuals
from forcegp.model import Model

KNOTS, BLOCKS = 8, 10  # of position, evenly over the rows; of time, each of which is told by the others
ASKED = 0.6  # of what is left of a torque, below which a function of position leaves it
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
