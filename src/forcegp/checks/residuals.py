"""What the torques that an identified robot leaves depend on."""

import numpy as np

from forcegp.data import Dataset
from forcegp.evidence import motion_residuals
from forcegp.model import Model

KNOTS, BLOCKS = 8, 10  # of position, evenly over the rows; of time, each of which is told by the others
ASKED = 0.6
"""Share of what is left of a joint's torque below which a function of its position leaves it."""
LEAST = 1e-3
"""Share of the torque's own power that is worth another law."""


def pushed_where_they_are(rows: Dataset, model: Model) -> tuple[str, ...]:
    """Joints whose torque the model misses by a function of their position, as of springs and cables."""
    left, found = motion_residuals(rows, model)[0], list[str]()
    for j, name in enumerate(rows.joint_names):
        q, missed = rows.q[:, j], left[:, j] - left[:, j].mean()
        knots = np.unique(np.quantile(q, np.linspace(0.0, 1.0, KNOTS)))
        hats = np.stack([np.interp(q, knots, each) for each in np.eye(len(knots))], axis=1)
        remains = 0.0
        for part in np.array_split(np.arange(len(rows)), BLOCKS):
            others = np.setdiff1d(np.arange(len(rows)), part)
            level = np.linalg.lstsq(hats[others], missed[others], rcond=1e-6)[0]
            remains += float(np.square(missed[part] - hats[part] @ level).sum())
        power = float(np.square(missed).sum())
        if remains < ASKED * power and power > LEAST * float(np.square(rows.u[:, j] - rows.u[:, j].mean()).sum()):
            found.append(name)
    return tuple(found)
