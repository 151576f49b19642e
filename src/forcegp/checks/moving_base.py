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
        q, own = torch.tensor(dataset.q[after]), torch.tensor(dataset.v[after])
        gravity = system.robot.gravity.to(q.device)
        specific = _rms(change[:, group.rows] - _of_specific_force(group, q, own, a, gravity))
        if error > 2.0 * size and specific < CLEARLY * error:
            yield wrong(
                subject="base acceleration",
                seen=f"the acceleration of {group.name!r} is what an accelerometer measures: as the change of its "
                f"velocity it is off by {error:.2g}, with gravity and w x v taken into account by {specific:.2g}.",
                remedy="forcegp import --axes a=imu; or differentiate v.",
                numbers={"error": error, "specific": specific, "size": size},
            )
        elif error > 2.0 * size:  # noise of the velocities alone makes both large
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
    body = _in_body(group, q0, own)

    def error(first: Tensor, second: Tensor, velocity: Tensor, part: list[int]) -> float:
        moved = robot.space.difference(first, second)[:, group.rows] / step
        return _rms((moved - velocity)[:, part])

    def mistaken(recorded: float, other: float, speed: float) -> bool:
        return recorded > CLEARLY * speed and other < CLEARLY * min(recorded, speed)

    whole = list(range(own.shape[1]))
    recorded, speed = error(q0, q1, own, whole), _rms(own)
    parts = {"linear ": [k for k in whole if group.motion.free[k] < 3]}
    parts["angular "] = [k for k in whole if k not in parts["linear "]]
    of_world = [
        name
        for name, part in parts.items()
        if part and mistaken(error(q0, q1, own, part), error(q0, q1, body, part), _rms(own[:, part]))
    ]
    reading, other, remedy = "", recorded, ""
    if of_world:
        reading = f"{of_world[0] if len(of_world) == 1 else ''}velocities in the axes of the world"
        axes = [name in of_world for name in parts]
        stated = ",".join("world" if each else "body" for each in (axes if axes[0] != axes[1] else axes[:1]))
        turned = own.clone()
        for name in of_world:
            turned[:, parts[name]] = body[:, parts[name]]
        other, remedy = (
            error(q0, q1, turned, whole),
            f"forcegp import --axes v={stated}, or R^T v of the orientation R.",
        )
    if group.kind != "planar":
        turn = slice(group.place + group.motion.turn.start, group.place + group.motion.turn.stop)
        first, second = q0.clone(), q1.clone()
        first[:, turn], second[:, turn] = q0[:, turn].roll(-1, -1), q1[:, turn].roll(-1, -1)
        reordered = error(first, second, own, whole)
        if mistaken(recorded, reordered, speed) and reordered < other:
            reading, other = "a quaternion w, x, y, z", reordered
            remedy = "forcegp import --orientation wxyz. Reorder its columns elsewhere: forcegp has x, y, z, w."
    numbers = {"as recorded": recorded, "speed": speed} | ({reading: other} if reading else {})
    if reading:
        yield wrong(
            subject="base",
            seen=f"positions of {group.name!r} change as if it had {reading}: off by {other:.2g}, as recorded by "
            f"{recorded:.2g}, of a speed of {speed:.2g}.",
            remedy=remedy,
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
    turned = (rotation.mT[:, None] @ _six(group, v).unflatten(-1, (2, 3))[..., None])[..., 0]
    return turned.flatten(1)[:, list(group.motion.free)]


def _of_specific_force(group: Group, q: Tensor, v: Tensor, a: Tensor, gravity: Tensor) -> Tensor:
    """The derivative of v if `a` has the specific force at the origin of the base: f + R^T g - w x v."""
    rotation, _ = pose(group.kind, q[:, group.places])
    six, moving = _six(group, a[:, group.rows]), _six(group, v[:, group.rows])
    six[:, :3] += (rotation.mT @ gravity[:, None])[..., 0] - torch.linalg.cross(moving[:, 3:], moving[:, :3])
    return six[:, list(group.motion.free)]


def _six(group: Group, values: Tensor) -> Tensor:
    """Linear and angular part (rows, 6), 0 where the base cannot move."""
    six = values.new_zeros(len(values), 6)
    six[:, list(group.motion.free)] = values
    return six


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())
