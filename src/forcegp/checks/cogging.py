"""Torques that repeat over equal ways of a joint: magnets of its motor, or teeth of its gear."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from forcegp.checks.causes import NUMBER, Candidate, number
from forcegp.checks.check_input import CheckInput
from forcegp.checks.torques import Comparison, solved
from forcegp.data.ripple import rate_of_waves, waves
from forcegp.doubts import listed


def cogging(now: Comparison, inputs: CheckInput, bad: np.ndarray) -> Iterator[Candidate]:
    """One wave over the position of every joint that fits badly, where it explains most of what is left."""
    rows, more, sizes = now.rows, np.zeros_like(now.rows.u), dict[int, tuple[float, float]]()
    for joint in np.flatnonzero(bad).tolist():
        q, basis = rows.q[:, joint], np.linalg.qr(now.friction[:, joint])[0]
        if rate := rate_of_waves(q, rows.u[:, joint] - now.tau[:, joint], basis):
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
