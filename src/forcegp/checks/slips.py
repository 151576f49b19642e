"""Positions that jump: an encoder that has slipped or was set anew, or that stood still before."""

from collections.abc import Iterator

import numpy as np

from forcegp.checks.check_input import CheckInput, single_rows
from forcegp.data.views import consecutive
from forcegp.doubts import Doubt, wrong

STOOD = 5  # equal positions in front of a jump, from which on the encoder had stopped


def slips(inputs: CheckInput) -> Iterator[Doubt]:
    """Single steps of positions that are far from those just before and after, unlike all others."""
    log, follows = inputs.log, consecutive(inputs.log)[:-1]
    for joint, name in enumerate(() if inputs.jumps.any() else inputs.names):
        steps = np.diff(log.q[:, joint])
        for row in single_rows(steps, follows[:-1] & follows[1:])[:1].tolist():
            moved = np.flatnonzero(steps[:row])
            first = int(moved[-1]) + 1 if len(moved) else 0
            begin, then, at, end = log.time[[0, first, row + 1, -1]].tolist()
            size = f"{steps[row]:+.3g} {inputs.unit_of_each('q')[joint]}"
            stood = row - first >= STOOD
            seen = f"jumps by {size} at {at:.3f} s and stays there: its encoder has slipped, or was set anew."
            left_out = (then, at) if stood else (at, end) if at - begin > end - at else (begin, at)
            if stood:
                seen = f"stands still from {then:.3f} s on and jumps by {size} at {at:.3f} s: its encoder was dead."
            yield wrong(
                about="frozen channel" if stood else "jumps",
                what=f"the position of {name} {seen}",
                do="Leave {} out by forcegp import --without {:.3f},{:.3f}{}.".format(
                    "these rows" if stood else "the shorter part", *left_out, "" if stood else ", or correct it"
                ),
                joints=(name,),
                numbers={"jump": float(steps[row]), "time": at, "still": at - then},
            )
