"""Robots whose base moves: do positions, velocities and accelerations belong together, in which axes, in which order.

State estimators differ: quaternions begin or end with w, velocities are those of the body's or of the world's axes.
Each reading predicts how positions change from row to row; that which the log obeys shows.
"""

import contextlib
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from forcegp.checks.check_input import Finding, import_flags, look, ok, wrong
from forcegp.checks.successive_rows import consecutive
from forcegp.data import Dataset, thruster_columns
from forcegp.data.configurations import in_base
from forcegp.mechanics import MechanicalSystem
from forcegp.robots import Robot
from forcegp.robots.manifold import Group

CLEARLY = 0.3
"""Another reading is right where its error is below this share of the error as recorded, and
itself below this share of the speed; and by how much the share that it explains may differ from 1."""
SURE = 20.0
"""Standard errors of independent rows by which other axes have to fit better: successive rows are not independent."""
TINY = 1e-24
MOST_ROWS = 2000
CARRIED = 0.5
"""Of the weight: a larger force in half of the rows carries the robot."""
IMU = {"axes": {"a": ("imu",)}}


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
        yield from _of_velocity(system.robot, group, q0, q1, step, middle, _stated_axes(dataset))
        error, size = _rms(change[:, group.rows] - a[:, group.rows]), _rms(change[:, group.rows])
        at, gravity = q0[:, group.places], system.robot.gravity
        measured = in_base(group, at, a[:, group.rows], ("imu", "body"), middle[:, group.rows], gravity)
        specific = _rms(change[:, group.rows] - measured)
        if error > 2.0 * size and specific < CLEARLY * error:
            yield wrong(
                subject="base acceleration",
                seen=f"the acceleration of {group.name!r} is what an accelerometer measures: as the change of its "
                f"velocity it is off by {error:.2g}, with gravity and w x v taken into account by {specific:.2g}.",
                remedy=f"forcegp import {import_flags(IMU)}; or differentiate v.",
                correction=IMU,
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


def carried_findings(dataset: Dataset, system: MechanicalSystem) -> Iterator[Finding]:
    """A base that floats and does not fall, although no foot, thruster or known force of the system carries it."""
    robot, rows = system.robot, np.linspace(0, len(dataset) - 1, min(len(dataset), MOST_ROWS)).astype(int)
    weight = float(torch.linalg.vector_norm(robot.gravity)) * sum(robot.link(name).mass for name in robot.layout.moving)
    for group in robot.layout.groups[:1]:
        if group.kind != "floating" or system.contacts or thruster_columns(system) or not weight:
            continue
        inputs = dataset.u if dataset.u.shape[1] == len(system.inputs) else np.zeros((len(dataset), len(system.inputs)))
        given = (dataset.q, dataset.v, inputs, dataset.a)
        q, v, u, a = (torch.tensor(each[rows], device=robot.device) for each in given)
        dynamics = system.dynamics(q, v, u)
        force = ((dynamics.M @ a[..., None])[..., 0] - dynamics.Q_K)[:, group.rows][:, :3]
        size = float(torch.linalg.vector_norm(force, dim=-1).median())
        if size > CARRIED * weight:
            yield wrong(
                subject="base force",
                seen=f"{group.name!r} does not fall: it moves under {size:.3g} N that nothing in the system explains, "
                f"no foot that stands and no thruster (the robot weighs {weight:.3g} N).",
                remedy="Describe them in Python (docs/how-to/moving-bases.md), write system.to_json() into a file, and "
                "take it in the place of the robot: forcegp import LOG --identified FILE, and so with forcegp auto.",
                numbers={"force": size, "weight": weight},
            )


def _stated_axes(dataset: Dataset) -> tuple[str, str]:
    """Of linear and angular velocities in the log file, as its import was given them."""
    with contextlib.suppress(AttributeError, TypeError, KeyError, ValueError):  # somebody else's metadata
        *_, linear, angular = 2 * tuple(dataset.metadata["import"]["mapping"]["axes"]["v"])
        return str(linear), str(angular)
    return "body", "body"


def _of_velocity(
    robot: Robot, group: Group, q0: Tensor, q1: Tensor, step: Tensor, v: Tensor, stated: tuple[str, str]
) -> Iterator[Finding]:
    own = v[:, group.rows]
    whole = list(range(own.shape[1]))
    parts = {"linear ": [k for k in whole if group.motion.free[k] < 3]}
    parts["angular "] = [k for k in whole if k not in parts["linear "]]

    def mistaken(recorded: float, other: float, speed: float) -> bool:
        return recorded > CLEARLY * speed and other < CLEARLY * min(recorded, speed)

    def best_axes(first: Tensor, second: Tensor) -> tuple[list[str], float]:
        """Which parts of v fit in the axes of the world only, and the error that is left with them turned."""
        moved = robot.space.difference(first, second)[:, group.rows] / step
        body, turned, of_world = in_base(group, first[:, group.places], own, ("world", "world")), own.clone(), []
        for name, part in parts.items():
            if part and _explained((moved - own)[:, part], (body - own)[:, part]):
                turned[:, part] = body[:, part]
                of_world.append(name)
        return of_world, _rms(moved - turned)

    recorded = _rms(robot.space.difference(q0, q1)[:, group.rows] / step - own)
    speed, meant, correction = _rms(own), list[str](), dict[str, dict[str, tuple[str, ...]]]()
    of_world, other = best_axes(q0, q1)
    if group.kind != "planar":
        turn = slice(group.place + group.motion.turn.start, group.place + group.motion.turn.stop)
        first, second = q0.clone(), q1.clone()
        first[:, turn], second[:, turn] = q0[:, turn].roll(-1, -1), q1[:, turn].roll(-1, -1)
        axes, reordered = best_axes(first, second)
        if mistaken(recorded, reordered, speed) and reordered < other:
            of_world, other = axes, reordered
            meant, correction["orientation"] = ["a quaternion w, x, y, z"], {"q": ("wxyz",)}
    if of_world:
        both = len(of_world) == 2
        meant.append(f"{'' if both else of_world[0]}velocities in the axes of the world")
        axes = tuple("world" if part in of_world else now for part, now in zip(parts, stated, strict=True))
        correction["axes"] = {"v": axes[:1] if len(set(axes)) == 1 else axes}
    reading = " and ".join(meant)
    remedy = (
        f"forcegp import {import_flags(correction)}. A Dataset has x, y, z, w and velocities R^T p' and w of the base."
    )
    numbers = {"as recorded": recorded, "speed": speed} | ({reading: other} if reading else {})
    if reading:
        yield wrong(
            subject="base",
            seen=f"positions of {group.name!r} change as if it had {reading}: off by {other:.2g}, as recorded by "
            f"{recorded:.2g}, of a speed of {speed:.2g}.",
            remedy=remedy,
            correction=correction,
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


def _explained(error: Tensor, difference: Tensor) -> bool:
    """Whether `difference` (rows, k), what another reading changes, is what the `error` consists of.

    Its coefficient in a regression of the error is 1 for the other reading, 0 for this one, and 1/2 where both are
    noise: noise e of v changes the difference by R^T e - e, of which the error has the part -e.
    """
    variance = torch.minimum(error.square().mean(0), (error - difference).square().mean(0)).clamp_min(TINY)
    weight = float((difference.square() / variance).sum())
    share = float((error * difference / variance).sum()) / weight if weight > 0.0 else 0.0
    return abs(share - 1.0) < CLEARLY and (share - 0.5) * weight**0.5 > SURE


def _rms(values: Tensor) -> float:
    return float(values.square().mean().sqrt())
