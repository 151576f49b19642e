"""What the torques that an identified robot leaves depend on."""

import numpy as np

from forcegp.data import Dataset
from forcegp.evidence import motion_residuals
from forcegp.model import Model

KNOTS, BLOCKS = 8, 10  # of position, evenly over the rows; of time, each of which is told by the others
ASKED = 0.6  # of what is left of a torque, below which a function of position leaves it
LEAST = 1e-3  # of the torque's own power, which is worth another law


def pushed_where_they_are(rows: Dataset, model: Model) -> tuple[str, ...]:
    """Joints whose torque the model misses by a function of their position, as of springs and cables."""
    left, found = motion_residuals(rows, model)[0], list[str]()
    for name, q, u, missed in zip(rows.joint_names, rows.q.T, rows.u.T, (left - left.mean(axis=0)).T, strict=False):
        knots = np.unique(np.quantile(q, np.linspace(0.0, 1.0, KNOTS)))
        hats = np.stack([np.interp(q, knots, each) for each in np.eye(len(knots))], axis=1)
        remains = 0.0
        for part in np.array_split(np.arange(len(rows)), BLOCKS):
            others = np.setdiff1d(np.arange(len(rows)), part)
            level = np.linalg.lstsq(hats[others], missed[others], rcond=1e-6)[0]
            remains += float(np.square(missed[part] - hats[part] @ level).sum())
        power = float(np.square(missed).sum())
        if remains < ASKED * power and power > LEAST * len(u) * float(u.var()) > 0.0:  # passive joints have rounding
            found.append(name)
    return tuple(found)
