"""Positions of robots whose base moves, as signals: filtered, differentiated and written as vectors.

Quaternions whose signs are continuous are filtered by entry and divided by their length: turns of the world commute.
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from forcegp.data.dataset import Dataset
from forcegp.errors import DatasetError
from forcegp.robots.manifold import TURN, ConfigurationSpace, pose

LEAST_LENGTH = 0.7  # of a filtered quaternion: below it the turn is faster than what the filter passes
LARGEST_TURN = 0.5 * np.pi  # between two rows: beyond it the log does not show which way a body has turned

Positions = Float[np.ndarray, "rows nq"]


def continuous(space: ConfigurationSpace, q: Positions) -> Positions:
    """The same with quaternions that change sign nowhere. DatasetError for a quarter of a turn between two rows."""
    for group in space.groups:
        turn = slice(group.place + TURN.start, group.place + TURN.stop)
        followed, jumped = following(q[:, turn], q[0, turn])
        if jumped.any():
            row = np.argmax(jumped) - 1
            seen = f"{group.name!r} turns by more than {np.degrees(LARGEST_TURN):.0f} degrees after row {row}"
            raise DatasetError(f"{seen}; check the order of the quaternion's columns, or leave these rows out.")
        q = q.copy()
        q[:, turn] = followed
    return q


def following(
    turn: Float[np.ndarray, "rows parts"], before: Float[np.ndarray, " parts"]
) -> tuple[Float[np.ndarray, "rows parts"], Bool[np.ndarray, " rows"]]:
    """Turns whose quaternions have the sign that is nearer to the row before, and rows that turn too far from it."""
    cosine = (turn * np.vstack([before, turn[:-1]])).sum(axis=1)
    turn = turn * np.cumprod(np.where(cosine < 0.0, -1.0, 1.0))[:, None]
    return turn, np.abs(cosine) < np.cos(LARGEST_TURN / 2)  # quaternions turn by half the angle


def through(
    space: ConfigurationSpace, q: Positions, change: Callable[[np.ndarray], np.ndarray]
) -> Float[np.ndarray, "_ nq"]:
    """Positions behind a linear filter `change`. Raises DatasetError for turns faster than the filter passes."""
    if space.is_vector_space:
        return change(q)
    changed = change(continuous(space, q))
    for group in space.groups:
        if float(np.median(np.linalg.norm(changed[:, group.places][:, TURN], axis=1))) < LEAST_LENGTH:
            raise DatasetError(f"{group.name!r} turns faster than the filter passes; use a higher cut-off.")
    return space.normalized(torch.from_numpy(np.ascontiguousarray(changed))).numpy()


def rates(space: ConfigurationSpace, q: Positions, time: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "rows nv"]:
    """Velocities by differences of second order, as :func:`~forcegp.data.differentiate` has them for vectors.

    In the chart of `Robot.difference` about every row, the derivative of the parabola through its neighbours is the
    velocity in body axes. Constant velocities come out exactly.
    """
    near = np.clip(np.arange(len(q)), 1, len(q) - 2)[:, None] + np.array([-1, 0, 1])
    steps = time[near] - time[:, None]
    weights = np.empty_like(steps)
    for k in range(3):
        one, other = steps[:, (k + 1) % 3], steps[:, (k + 2) % 3]
        weights[:, k] = -(one + other) / ((steps[:, k] - one) * (steps[:, k] - other))
    positions = torch.tensor(q)
    return np.einsum("nk,nkj->nj", weights, space.difference(positions[:, None], positions[near]).numpy())


def in_base(
    q: Float[Tensor, "rows positions"],
    values: Float[Tensor, "rows velocities"],
    axes: tuple[str, str],
    v: Float[Tensor, "rows velocities"] | None = None,
    gravity: Float[Tensor, "3"] | None = None,
) -> Float[Tensor, "rows velocities"]:
    """v of a base at its positions q, or with `v` and `gravity` its derivative a, from what was measured in `axes`.

    `axes` are those of the linear and of the angular part: "body", "world", or "imu". A Dataset has v = (R^T p', w) and
    its plain derivative. So world axes give v' = R^T p'' - w x R^T p', and an accelerometer at the origin of the base,
    which measures f = R^T (p'' - g), gives v' = f + R^T g - w x R^T p' (Titterton & Weston, "Strapdown inertial
    navigation technology", 2004, section 3.5). Angular parts are alike: (R w)' = R (w' + w x w) = R w'.
    """
    inverse, found = pose(q)[0].mT, values.unflatten(-1, (2, 3)).clone()
    turned = (inverse[:, None] @ found[..., None])[..., 0]
    for part, name in enumerate(axes):
        if name == "world":
            found[:, part] = turned[:, part]
    if v is not None and gravity is not None and axes[0] != "body":
        found[:, 0] -= torch.linalg.cross(v[:, 3:], v[:, :3])
        if axes[0] == "imu":
            found[:, 0] += inverse @ gravity
    return found.flatten(1)


def as_vectors(dataset: Dataset) -> Float[np.ndarray, "rows nv"]:
    """Positions as vectors that change from row to row as the robot moves, in body axes; q itself on a fixed base."""
    space = dataset.model.robot.space
    if space.is_vector_space:
        return dataset.q
    q = torch.tensor(dataset.q)
    steps = space.difference(q[:-1], q[1:]).numpy()
    steps[np.diff(dataset.episode) != 0] = 0.0
    return np.concatenate([np.zeros((1, dataset.nv)), np.cumsum(steps, axis=0)])
