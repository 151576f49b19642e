"""Positions that jump and stay there: an encoder that has slipped, or was set anew."""

import numpy as np
from jaxtyping import Int

from forcegp.checks.check_input import STEPS, CheckInput
from forcegp.data.views import resolution
from forcegp.doubts import Doubt, wrong

FAR = 5.0  # times the other steps around it, from which on one is a slip


def slip(inputs: CheckInput, joint: int, rows: Int[np.ndarray, " rows"]) -> Doubt | None:
    """The step in positions of a joint of which velocities have a spike in these rows; None where there is none."""
    log, name = inputs.log, inputs.names[joint]
    around = np.arange(max(rows[0] - 2, 0), min(rows[-1] + 3, len(log)))
    steps = np.diff(log.q[around, joint])
    most = int(np.argmax(np.abs(steps)))
    others = np.abs(np.delete(steps, most)).max(initial=STEPS * resolution(log.q[:, joint]))
    if abs(steps[most]) < FAR * others:
        return None
    begin, at, end = (float(log.time[row]) for row in (0, around[most + 1], -1))
    short = (at, end) if at - begin > end - at else (begin, at)
    return wrong(
        about="jumps",
        what=f"the position of {name} jumps by {steps[most]:+.3g} {inputs.unit_of_each('q')[joint]} at {at:.3f} s and "
        "stays there: its encoder has slipped, or was set anew.",
        do="Leave the shorter part out by forcegp import --without {:.3f},{:.3f}, or correct it.".format(*short),
        joints=(name,),
        numbers={"jump": float(steps[most]), "time": at},
    )
