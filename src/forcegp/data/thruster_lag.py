"""How late thrusters follow their commands, from a recording of a robot that flies."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import forcegp.forces
import forcegp.mechanics
from forcegp.data.dataset import Dataset
from forcegp.data.delay import jackknife, least_squares, lowest
from forcegp.data.filters import Lag
from forcegp.data.sampling import episodes_in_order
from forcegp.errors import DatasetError, InvalidInput
from forcegp.robots.manifold import Group

FAST = 0.1  # s: slower changes, of wind and of what controllers answer to it, do not count
TRIED = np.linspace(0.0, 0.3, 31)  # s
BLOCK = 4096  # rows
SETTLED = 0.5  # s, of an episode, after which nothing depends on how it began


def estimate_thruster_lag(dataset: Dataset) -> tuple[float, float]:
    """Time constant [s] of thrusters that follow u by first order, T s' + s = u, and its standard deviation.

    For every T, the force that the base's acceleration needs is fitted by least squares to what thrusters, air and
    joints can do: each thruster, its speed times the velocity (Mahony et al. 2012), velocity, its square, rates, their
    products, attitude, thrust times velocity, and the torque regressor of bodies that joints move beside the base.
    With such bodies only forces count, no torques: a load on an arm changes inertias far more than the mass, which
    looked like a lag (72 ms of none). All columns lose their slow part first, for wind is slow and controllers answer
    it, which made lags up to a third too short. The best T has the least sum of log residuals, by a parabola; its
    deviation comes from leaving out each eighth of the time (block jackknife, as in `estimate_delay`), and from half a
    step of time, by which a command that holds until the next row is later than one that does not. Raises InvalidInput
    without `Thrusters` on a base that moves freely, and DatasetError where the recording is too short, or shows no lag
    below .3 s.
    """
    found = thruster_columns(dataset.model)
    if dataset.model is None or not found:
        raise InvalidInput("this lag is that of thrusters: give a model with Thrusters and base='floating'.")
    columns, powers, group = list(found), np.array(list(found.values())), dataset.model.robot.layout.groups[0]
    episodes = [part for _, part, _ in episodes_in_order(dataset) if part.time[-1] - part.time[0] > 2.0 * SETTLED]
    if sum(map(len, episodes)) < 1000:
        raise DatasetError(
            "the recording is too short for the lag of thrusters; record 1,000 rows or more, or give the lag in s."
        )
    forces, moved = (
        np.concatenate([_fast(values, part.time) for values, part in zip(each, episodes, strict=True)])
        for each in zip(*(_base_forces(part, group) for part in episodes), strict=True)
    )
    misfits = []
    for seconds in TRIED:
        causes = [_causes(part, columns, powers, group, float(seconds)) for part in episodes]
        X = np.concatenate([_fast(own, part.time) for own, part in zip(causes, episodes, strict=True)])
        if moved.shape[1] == 0:
            misfits.append(_misfits(X, forces))
        else:  # each force has columns of its own
            own = zip(np.split(moved, 3, axis=1), forces[:, :3].T, strict=True)
            misfits.append(sum(_misfits(np.hstack([X, more]), force[:, None]) for more, force in own))
    lags = np.array([lowest(profile, TRIED) if np.argmin(profile) else 0.0 for profile in np.array(misfits).T])
    if not np.isfinite(lags).all():
        raise DatasetError("the recording shows no lag of the thrusters below .3 s; give the lag in s, or 0.")
    half = 0.5 * float(np.median(np.diff(episodes[0].time)))
    return float(lags[0]), float(np.hypot(jackknife(lags[None, 1:])[0], half))


def thruster_columns(model: forcegp.Model | None) -> dict[int, int]:
    """Columns of u that push a base that floats, and the powers in which they act: `Thrusters`, and such actuators."""
    groups = () if model is None else model.robot.layout.groups
    if model is None or not groups or groups[0].kind != "floating":
        return {}
    matrix = model.actuation.matrix
    pushes = [] if matrix is None else np.flatnonzero(torch.as_tensor(matrix)[groups[0].rows].cpu().numpy().any(0))
    kind = forcegp.forces.Thrusters
    thrusters = [force for force in model.forces if isinstance(force, kind)]
    named = {model.inputs.index(name): force.power for force in thrusters for name in force.names}
    return {**{int(column): 1 for column in pushes}, **named}


def _causes(
    part: Dataset, columns: list[int], powers: np.ndarray, group: Group, seconds: float
) -> Float[np.ndarray, "rows causes"]:
    late = Lag(seconds)(part.u[:, columns], part.time)
    thrust = np.where(powers == 2, late * np.abs(late), late)
    v, w = part.v[:, group.rows][:, :3], part.v[:, group.rows][:, 3:]
    axes = Rotation.from_quat(part.q[:, group.places][:, group.motion.turn]).as_matrix().reshape(-1, 9)
    fast = np.linalg.norm(v, axis=1, keepdims=True)
    spinning = np.where(powers == 2, late, np.sqrt(np.abs(late)))[..., None] * v[:, None]
    turning = [np.cross(w, v), w[:, [1, 2, 0]] * w[:, [2, 0, 1]]]
    parts = [thrust, thrust.sum(1, keepdims=True) * v, v, fast * v, w, *turning, axes, spinning.reshape(len(v), -1)]
    return np.concatenate(parts, axis=1)


def _base_forces(part: Dataset, group: Group) -> tuple[np.ndarray, np.ndarray]:
    """Forces (rows, 6) that accelerate the base, and for each of the first three k columns of bodies beside it."""
    assert part.model is not None
    robot, found = part.model.robot, []
    for start in range(0, len(part), BLOCK):
        q, v, a = (torch.tensor(x[start : start + BLOCK], device=robot.device) for x in (part.q, part.v, part.a))
        with torch.no_grad():
            at = robot.kinematics(q, v)
            base = at.mass_matrix()[:, group.rows, group.rows] @ a[:, group.rows, None]
            a[:, group.rows] = 0.0  # what is fitted explains nothing
            regressor = at.torque_regressor(a)[:, group.rows, group.bodies.stop :][:, :3]
            found.append((base[..., 0].cpu().numpy(), regressor.flatten(1).cpu().numpy()))
    forces, moved = zip(*found, strict=True)
    return np.concatenate(forces), np.concatenate(moved)


def _fast(values: Float[np.ndarray, "rows k"], time: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "kept k"]:
    """Without what a low pass of first order leaves, where that has settled."""
    return (values - Lag(FAST)(values, time))[time - time[0] > SETTLED]


def _misfits(X: Float[np.ndarray, "rows causes"], target: Float[np.ndarray, "rows k"]) -> Float[np.ndarray, " parts"]:
    """Sums of log residuals of all rows, and without each block."""
    left = least_squares(X / (np.linalg.norm(X, axis=0) + 1e-300), target)
    return np.log(np.maximum(left, 1e-300)).sum(axis=1)
