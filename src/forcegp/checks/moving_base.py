"""Robots whose base moves: do positions, velocities and accelerations belong together, in which axes, in which order.

State estimators differ: quaternions begin or end with w, velocities are those of the body's or of the world's axes.
Each reading predicts how positions change from row to row; that which the log obeys shows.
"""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from forcegp.checks.check_input import Finding, look, ok, wrong
from forcegp.checks.successive_rows import consecutive
from forcegp.data import Dataset
from forcegp.mechanics import MechanicalSystem
from forcegp.robots import Robot
from forcegp.robots.manifold import Group, pose

CLEARLY = 0.3
"""Another reading is right where its error is below this share of the error as recorded, and
itself below this share of the speed."""
MOST_ROWS = 2000


def base_findings(dataset: Dataset, system: MechanicalSystem) -> Iterator[Finding]:
    """What is seen of the bases of a log; the joints of one degree of freedom are not looked at."""
    after = np.flatnonzero(consecutive(dataset)[:-1])[:MOST_ROWS]
    if not dataset.time_ordered or len(after) < 10:
        yield look(subject="base", seen="too few successive rows to compare positions and velocities of the base.")
        return
    step = torch.tensor(np.diff(dataset.time)[after])[:, None]
    q0, q1 = (torch.tensor(dataset.q[rows]) for rows in (after, after + 1))
    middle = torch.tensor(0.5 * (dataset.v[after] + dataset.v[after + 1]))
    change = torch.tensor(dataset.v[after + 1] - dataset.v[after]) / step
    a = torch.tensor(0.5 * (dataset.a[after] + dataset.a[after + 1]))
    for group in system.robot.layout.groups:
        yield from _of_velocity(system.robot, group, q0, q1, step, middle)
        error, size = _rms(change[:, group.rows] - a[:, group.rows]), _rms(change[:, group.rows])
        if error > 2.0 * size:  # noise of the velocities alone makes both large
            yield look(
                subject="base acceleration",
                seen=f"the acceleration of {group.name!r} is off from the change of its velocity by {error:.2g}, "
                f"which itself is {size:.2g}.",
                remedy="Accelerations are derivatives of velocities in body axes, without gravity and without w x v of "
                "an accelerometer; differentiate v, or add gravity to what an IMU measures.",
                numbers={"error": error, "size": size},
            )


def _of_velocity(robot: Robot, group: Group, q0: Tensor, q1: Tensor, step: Tensor, v: Tensor) -> Iterator[Finding]:
    own = v[:, group.rows]
    speed = _rms(own)

    def error(first: Tensor, second: Tensor, velocity: Tensor) -> float:
        moved = robot.space.difference(first, second)[:, group.rows] / step
        return _rms(moved - velocity)

    recorded = error(q0, q1, own)
    readings = {"velocities in the axes of the world": error(q0, q1, _in_body(group, q0, own))}
    remedies = {
        "velocities in the axes of the world": "Turn them into the axes of the base: R^T v of its orientation R."
    }
    if group.kind != "planar":
        turn = slice(group.place + group.motion.turn.start, group.place + group.motion.turn.stop)
        order = "a quaternion w, x, y, z"
        first, second = q0.clone(), q1.clone()
        first[:, turn], second[:, turn] = q0[:, turn].roll(-1, -1), q1[:, turn].roll(-1, -1)
        readings[order] = error(first, second, own)
        remedies[order] = "Reorder its columns: forcegp has x, y, z, w."
    best = min(readings, key=lambda name: readings[name])
    numbers = {"as recorded": recorded, **readings, "speed": speed}
    if recorded > CLEARLY * speed and readings[best] < CLEARLY * min(recorded, speed):
        yield wrong(
            subject="base",
            seen=f"positions of {group.name!r} change as if it had {best}: off by {readings[best]:.2g}, as recorded by "
            f"{recorded:.2g}, of a speed of {speed:.2g}.",
            remedy=remedies[best],
            numbers=numbers,
        )
    elif recorded > CLEARLY * speed and speed > 0.0:
        yield look(
            subject="base",
            seen=f"positions of {group.name!r} do not change as its velocities say: off by {recorded:.2g} of "
            f"{speed:.2g}.",
            remedy="Check units and time stamps, and that v is linear, then angular velocity in the axes of the base.",
            numbers=numbers,
        )
    else:
        yield ok(subject="base", seen=f"positions and velocities of {group.name!r} agree.", numbers=numbers)


def _in_body(group: Group, q: Tensor, v: Tensor) -> Tensor:
    """Velocities of the world's axes in those of the body."""
    rotation, _ = pose(group.kind, q[:, group.places])
    six = v.new_zeros(len(v), 6)
    six[:, list(group.motion.free)] = v
    turned = (rotation.mT[:, None] @ six.unflatten(-1, (2, 3))[..., None])[..., 0]
    return turned.flatten(1)[:, list(group.motion.free)]


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())
