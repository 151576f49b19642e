"""A robot in a plane that falls in it, although its gravity has no part there."""

import numpy as np
import torch

import forcegp.mechanics
from forcegp.data.dataset import Dataset

EARTH, NEAR, OFTEN = 9.81, 0.5, 0.1
"""m/s^2: of free fall, and about it; share of the rows in which a robot falls so."""
ALONG = 0.05
"""Of a unit vector: parts below this are none."""


def missing_gravity(dataset: Dataset, model: forcegp.Model) -> tuple[str, str] | None:
    """What shows that a robot in a plane falls in it although its gravity has no part there, and the remedy."""
    robot = model.robot
    if robot.base != "planar" or robot.gravity[:2].any():
        return None
    q, v, a = (torch.tensor(x, device=robot.device) for x in (dataset.q, dataset.v, dataset.a))
    force = robot.kinematics(q, v).inverse_dynamics(a)[:, :2].cpu().numpy() / robot.mass  # in the axes of the base
    c, s = dataset.q[:, 2], dataset.q[:, 3]
    motion = np.stack([c * force[:, 0] - s * force[:, 1], s * force[:, 0] + c * force[:, 1]], 1)
    near = abs(np.linalg.norm(motion, axis=1) - EARTH) < NEAR
    if not near.any():
        return None
    fall = np.median(motion[near], axis=0)
    often, size = (np.linalg.norm(motion - fall, axis=1) < NEAR).mean(), np.linalg.norm(fall)
    if often < OFTEN or abs(size - EARTH) > NEAR:
        return None
    direction = fall / size
    direction = np.where(abs(direction) < ALONG, 0.0, direction)
    x, y = EARTH * direction / np.linalg.norm(direction)
    return (
        f"in {often:.0%} of the rows the robot falls at ({fall[0]:.3g}, {fall[1]:.3g}) m/s^2 in its plane, in which it "
        "has no gravity",
        f"forcegp import --robot FILE --base planar --gravity={x + 0.0:.4g},{y + 0.0:.4g},0 reads it with gravity, as "
        f"Robot.from_urdf(..., gravity=({x + 0.0:.4g}, {y + 0.0:.4g}, 0)) does.",
    )
