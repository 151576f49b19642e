"""How late thrusters follow their commands, from a recording of a robot that flies."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import forcegp.mechanics
from forcegp.data.dataset import Dataset
from forcegp.data.delay import lagged, lowest
from forcegp.data.filtering import episodes_in_order
from forcegp.errors import DatasetError, InvalidInput

FAST = 0.1  # s: slower changes, of wind and of what controllers answer to it, do not count
TRIED = np.linspace(0.0, 0.3, 31)  # s
SETTLED = 0.5  # s, of an episode, after which nothing depends on how it began
BLOCKS = 8


def estimate_thruster_lag(dataset: Dataset) -> tuple[float, float]:
    """Time constant [s] of thrusters that follow u by first order, T s' + s = u, and its standard deviation.

    For every T, accelerations of the base are fitted by least squares to what thrusters and air can do: each thruster,
    velocity, speed times velocity, rates, their products, attitude, and thrust times velocity. All columns lose their
    slow part first, for wind is slow and controllers answer it, which made lags up to a third too short. The best T has
    the least sum of log residuals, by a parabola; its deviation comes from leaving out each eighth of the time (block
    jackknife, as in `estimate_delay`). Raises InvalidInput without `Thrusters` on a base that moves freely, and
    DatasetError where the recording is too short, or shows no lag below .3 s.
    """
    columns, powers, row = _thrusters(dataset)
    episodes = [part for _, part, _ in episodes_in_order(dataset) if part.time[-1] - part.time[0] > 2.0 * SETTLED]
    if sum(map(len, episodes)) < 1000:
        raise DatasetError(
            "the recording is too short for the lag of thrusters; record 1,000 rows or more, or give the lag in s."
        )
    target = np.concatenate([_fast(part.a[:, row : row + 6], part.time) for part in episodes])
    blocks = np.array_split(np.arange(len(target)), BLOCKS)
    misfits = []
    for seconds in TRIED:
        X = np.concatenate([_fast(_causes(part, columns, powers, row, float(seconds)), part.time) for part in episodes])
        X /= np.linalg.norm(X, axis=0) + 1e-300
        sums = [(X[k].T @ X[k], X[k].T @ target[k], np.square(target[k]).sum(0)) for k in blocks]
        whole = [np.sum(part, axis=0) for part in zip(*sums, strict=True)]
        without = [[a - b for a, b in zip(whole, own, strict=True)] for own in sums]
        misfits.append([_log_residual(*parts) for parts in (whole, *without)])
    found = np.array([lowest(profile, TRIED) for profile in np.array(misfits).T])
    if not np.isfinite(found).all():
        raise DatasetError("the recording shows no lag of the thrusters between 0 and .3 s; give the lag in s, or 0.")
    return float(found[0]), float(np.sqrt((BLOCKS - 1) * np.var(found[1:])))


def _thrusters(dataset: Dataset) -> tuple[list[int], np.ndarray, int]:
    """Columns of u of the thrusters, the powers of which they act, and the first row of the free base."""
    system = dataset.system
    kind = forcegp.mechanics.Thrusters
    forces = [] if system is None else [force for force in system.known_forces if isinstance(force, kind)]
    groups = () if system is None else system.robot.layout.groups
    if system is None or not forces or not groups or groups[0].kind != "floating":
        raise InvalidInput("this lag is that of thrusters: give a system with Thrusters and base='floating'.")
    named = [(name, force.power) for force in forces for name in force.names]
    return [system.inputs.index(name) for name, _ in named], np.array([power for _, power in named]), groups[0].row


def _causes(
    part: Dataset, columns: list[int], powers: np.ndarray, row: int, seconds: float
) -> Float[np.ndarray, "rows causes"]:
    late = np.stack([lagged(part.u[:, column], part.time, seconds) for column in columns], axis=1)
    thrust = np.where(powers == 2, late * np.abs(late), late)
    v, w = part.v[:, row : row + 3], part.v[:, row + 3 : row + 6]
    axes = Rotation.from_quat(part.q[:, row + 3 : row + 7]).as_matrix().reshape(-1, 9)
    speed = np.linalg.norm(v, axis=1, keepdims=True)
    turning = [np.cross(w, v), w[:, [1, 2, 0]] * w[:, [2, 0, 1]]]
    return np.concatenate([thrust, thrust.sum(1, keepdims=True) * v, v, speed * v, w, *turning, axes], axis=1)


def _fast(values: Float[np.ndarray, "rows k"], time: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "kept k"]:
    """Without what a low pass of first order leaves, where that has settled."""
    slow = np.stack([lagged(column, time, FAST) for column in values.T], axis=1)
    return (values - slow)[time - time[0] > SETTLED]


def _log_residual(normal: np.ndarray, right: np.ndarray, square: np.ndarray) -> float:
    solution = np.linalg.lstsq(normal, right, rcond=1e-12)[0]
    return float(np.log(np.maximum(square - (right * solution).sum(0), 1e-300)).sum())
