"""Does each channel carry a signal: constant and frozen channels, saturation, limits."""

from collections.abc import Iterator
from itertools import chain

import numpy as np

from forcegp.checks.check_input import CheckInput
from forcegp.data import Dataset
from forcegp.data.dataset_fields import unit_of_each
from forcegp.data.views import consecutive, runs
from forcegp.doubts import Doubt, listed, look, wrong

QUANTITY = {"q": "position", "v": "velocity", "u": "torque"}
EVERY_QUANTITY = {**QUANTITY, "a": "acceleration"}
ROUNDING = 1e-12  # of the largest value of any joint
HELD_STEPS = 0.5  # share of equal successive values from which on a signal moves in steps, such as a held command
FROZEN_SECONDS = 0.1
FROZEN_ROWS = 10
MOVES = 0.2  # of its root mean square speed, above which a joint moves
CLIPPED_RATIO = 8.0  # rows at the extreme value over rows in the next thousandth of the range: a smooth peak has 2.4
CLIPPED_ROWS = 10
TOLERANCE = 0.01  # of the range between limits, by which a position may exceed them: calibration


def signal_doubts(inputs: CheckInput) -> list[Doubt]:
    """Constant, frozen and clipped channels, limits of the URDF, angles that wrap or jump."""
    joints = range(inputs.log.nv)
    frozen = chain.from_iterable(_frozen(inputs, name, joint) for name in QUANTITY for joint in joints)
    clipped = chain.from_iterable(_clipped(inputs, joint) for joint in joints)
    found = [*_leaps(inputs), *_dropped(inputs), *_constant(inputs), *frozen, *clipped]
    return [*found, *_limits(inputs)]


def _leaps(inputs: CheckInput) -> Iterator[Doubt]:
    for places, how, remedy in (
        (inputs.wraps, "by a turn: the angle wraps", "Unwrap it (forcegp import --unwrap, or np.unwrap(q, axis=0))."),
        (inputs.jumps, "by more than pi", "Look at the raw log there; nothing could be differentiated, so motion and "
         "torque were not checked. Are the units right (degrees for radians)?"),
    ):  # fmt: skip
        if places.any():
            row, joint = (int(index) for index in np.argwhere(places)[0])
            name = inputs.names[joint]
            yield wrong(
                about="jumps",
                what=f"the position of {name} jumps {how} after row {row} at {inputs.log.time[row]:.3f} s "
                f"({int(places.sum())} times in all).",
                do=remedy,
                joints=inputs.named(np.flatnonzero(places.any(axis=0))),
                numbers={"row": row, "count": int(places.sum())},
            )


def _dropped(inputs: CheckInput) -> Iterator[Doubt]:
    """Rows of a signal that were lost and read 0."""
    lost = {name: rows for name, rows in inputs.dropped.items() if rows.any()}
    if not lost:
        return
    rows = np.logical_or.reduce([each.any(axis=1) for each in lost.values()])
    first = int(np.flatnonzero(rows)[0])
    joints = np.logical_or.reduce([each.any(axis=0) for each in lost.values()])
    yield wrong(
        about="drop-outs",
        what=f"{int(rows.sum())} rows ({100.0 * rows.mean():.2g} %) read exactly 0 between values that are far from 0, "
        f"in {listed(tuple(EVERY_QUANTITY[name] for name in lost))}; the first is row {first} at "
        f"{inputs.log.time[first]:.3f} s.",
        do="They were not measured: leave these rows out, and look at the logger.",
        joints=inputs.named(np.flatnonzero(joints)),
        numbers={"rows": int(rows.sum()), "row": first, "quantities": list(lost)},
    )


def _constant(inputs: CheckInput) -> Iterator[Doubt]:
    log = inputs.log
    rests = still(log, "v") & still(log, "q")
    for name, quantity in QUANTITY.items():
        values = getattr(log, name)
        dead = np.flatnonzero(still(log, name)).tolist()
        if not dead:
            continue
        names = inputs.named(dead)
        seen = f"the {quantity} of {listed(names)} never changes (it is {values[0, dead[0]] + 0.0:.6g} in every row)."
        remedy = "Right for a joint that was held; then lock it in the robot. Else the channel is dead."
        passive = name == "u" and not values[:, dead].any()
        if name == "u":
            remedy = "Right for a passive mechanism; else the torque columns are missing."
        if passive and len(dead) == log.nv:
            seen = "no torque was logged at all (every u is 0)."
        yield Doubt(
            level="look" if passive or len(dead) == log.nv or rests[dead].all() else "wrong",
            about="constant channel",
            what=seen,
            do=remedy,
            joints=names,
            numbers={"quantity": name},
        )


def still(log: Dataset, name: str) -> np.ndarray:
    """Which joints' signal never changes, up to rounding."""
    values = getattr(log, name)
    return np.ptp(values, axis=0) <= ROUNDING * np.abs(values).max(initial=0.0)


def _frozen(inputs: CheckInput, name: str, joint: int) -> Iterator[Doubt]:
    """A channel that stands still, to the last digit, while the joint's other channels show that it moves."""
    log = inputs.log
    values = getattr(log, name)[:, joint]
    follows = consecutive(log)[:-1]
    held = np.diff(values) == 0
    if np.ptp(values) == 0.0 or (name == "u" and held.mean() > HELD_STEPS):
        return
    changes = [np.diff(getattr(log, other)[:, joint]) != 0 for other in QUANTITY if other != name]
    others = np.logical_or.reduce(changes)
    seconds = np.diff(log.time)
    step = float(np.median(seconds[follows]))
    # a velocity that stands still at rest is right, also where the position is noisy; a joint that sticks while its
    # velocity is an estimate does not jump afterwards; and noise about rest goes nowhere
    speed = log.v[1:, joint] if name != "v" else np.where(follows, np.diff(log.q[:, joint]), 0.0) / step
    moves = np.abs(speed) > MOVES * np.sqrt(np.square(speed).mean())
    if name != "u":
        others &= np.diff(log.u[:, joint]) != 0  # at rest q and v stand still together, while u is noisy or not
    longest = (0, 0)
    for start, stop in runs(held & others & follows):
        length = int(stop - start)
        if length > longest[1] and length >= FROZEN_ROWS and length * step >= FROZEN_SECONDS:
            gone = np.cumsum(speed[start:stop]) * step
            sticks = name == "q" and stop < len(held) and abs(values[stop + 1] - values[start]) < 0.5 * abs(gone[-1])
            far = np.ptp(gone) > 0.25 * np.abs(speed[start:stop]).sum() * step
            if moves[start:stop].mean() > 0.5 and far and not sticks:
                longest = (int(start), length)
    start, length = longest
    if not length or values[start] in (values.min(), values.max()):
        return
    yield Doubt(
        level="look" if name == "u" and values[start] == 0.0 else "wrong",
        about="frozen channel",
        what=f"the {QUANTITY[name]} of {inputs.names[joint]} stands still at {values[start]:.6g} for "
        f"{length * step:.3g} s from row {start} at {log.time[start]:.3f} s, while its other signals change.",
        do="Leave this stretch out, and look at the logger.",
        joints=(inputs.names[joint],),
        numbers={"quantity": name, "row": start, "seconds": length * step},
    )


def _clipped(inputs: CheckInput, joint: int) -> Iterator[Doubt]:
    """Torque that stays at its extreme while the joint moves: far more rows there than just below."""
    log = inputs.log
    speed = np.abs(log.v[:, joint])
    u = log.u[speed > MOVES * np.sqrt(np.square(speed).mean()), joint]
    if len(u) < CLIPPED_ROWS or np.ptp(log.u[:, joint]) == 0.0:
        return
    width = np.ptp(u) / 1000.0
    for sign, side in ((1.0, "largest"), (-1.0, "smallest")):
        extreme = float((sign * log.u[:, joint]).max())
        below = extreme - sign * u
        at = int((below <= 1e-9 * np.ptp(u)).sum())
        near = int(((below > 1e-9 * np.ptp(u)) & (below <= 1e-9 * np.ptp(u) + width)).sum())
        extremes = runs(np.abs(log.u[:, joint] - sign * extreme) <= 1e-9 * np.ptp(u))
        start, stop = max(extremes.tolist(), key=lambda run: run[1] - run[0], default=(0, 0))
        length = stop - start
        if at >= CLIPPED_ROWS and at > CLIPPED_RATIO * max(near, 1) and length >= 3:
            yield wrong(
                about="saturation",
                what=f"the torque of {inputs.names[joint]} stays at its {side} value {sign * extreme:.5g} in "
                f"{at} rows of motion; the longest stretch, {length} rows, begins at row {start} at "
                f"{log.time[start]:.3f} s.",
                do="The robot received another torque than the log states, or the sensor is at its end: leave "
                "these stretches out, or move more gently.",
                joints=(inputs.names[joint],),
                numbers={"value": sign * extreme, "rows": at, "row": start},
            )


def _limits(inputs: CheckInput) -> Iterator[Doubt]:
    """Positions, velocities and torques beyond the limits of the URDF, the worst joint of each first."""
    if inputs.robot is None:
        return
    log, joints = inputs.log, inputs.robot.joints
    lower = np.array([-np.inf if joint.type == "continuous" else joint.lower for joint in joints])
    upper = np.array([np.inf if joint.type == "continuous" else joint.upper for joint in joints])
    bounds = {"q": (lower, upper)}
    for name, limit in (("v", "velocity_limit"), ("u", "effort_limit")):
        size = np.array([getattr(joint, limit) for joint in joints], dtype=float)
        size[~(size > 0.0)] = np.inf  # a limit of 0 is a placeholder
        bounds[name] = (-size, size)
    for name, (low, high) in bounds.items():
        values = getattr(log, name)
        span = np.where(np.isfinite(high - low), high - low, 1.0)
        excess = np.maximum(values - high, low - values) / span - TOLERANCE
        if not (excess > 0.0).any():
            continue
        row, joint = (int(index) for index in np.unravel_index(np.argmax(excess), excess.shape))
        beyond = inputs.named(np.flatnonzero((excess > 0.0).any(axis=0)))
        others = f" (also {listed(tuple(k for k in beyond if k != inputs.names[joint]))})" if len(beyond) > 1 else ""
        unit = unit_of_each(name, log.units[name], log.nv)[joint]
        yield look(
            about="limits",
            what=f"the {QUANTITY[name]} of {inputs.names[joint]} is {values[row, joint]:.4g} {unit} at row {row} "
            f"({log.time[row]:.3f} s), beyond [{low[joint]:g}, {high[joint]:g}] of the URDF{others}; "
            f"{int((excess > 0.0).any(axis=1).sum())} rows are.",
            do="Check units, sign and zero of this joint against the URDF; if they are right, the URDF's limit "
            "is not that of your robot, which does no harm here.",
            joints=beyond,
            numbers={"quantity": name, "row": row, "value": float(values[row, joint])},
        )
