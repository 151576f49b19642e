"""Does each channel carry a signal, are the rows even in time, and do q, v and a belong to each other."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from forcegp.checks.check_input import DEGREE, STEPS, STILL, CheckInput, slips
from forcegp.checks.torques import needed_torques
from forcegp.data import Dataset, differentiate, low_pass, preparation_report
from forcegp.data.delay import lowest
from forcegp.data.views import consecutive, ends_of_range, resolution, runs
from forcegp.doubts import Doubt, Level, listed, look, ok, wrong

QUANTITY = {"q": "position", "v": "velocity", "u": "torque"}
EVERY_QUANTITY = {**QUANTITY, "a": "acceleration"}
FINE = 3  # digits of a time beyond half a step
ROUNDING = 1e-12  # of the largest value of any joint
HELD_STEPS = 0.5  # share of equal successive values from which on a signal moves in steps, such as a held command
FROZEN_SECONDS = 0.1
FROZEN_ROWS = 10
AGREES = 0.6  # steps of the position from row to row, up to which a velocity agrees with it
NEEDED = 0.1  # of the largest torque of the joints that have one: less is that of a wrong mass
PASSIVE = 0.5  # of the inertial torque: a mechanism that swings by itself needs less
MOVES = 0.2  # of its root mean square speed, above which a joint moves


def signal_doubts(inputs: CheckInput) -> list[Doubt]:
    """Constant, frozen and clipped channels, angles that jump."""
    frozen = chain.from_iterable(_frozen(inputs, name, joint) for name in QUANTITY for joint in range(inputs.log.nv))
    jumps = [*_jumps(inputs), *slips(inputs)]  # of which derivatives have spikes
    dropped = _dropped(inputs, ("drop-outs",) if jumps else ("drop-outs", "spike"))
    return [*jumps, *dropped, *_constant(inputs), *frozen, *_clipped(inputs)]


FEWEST_VALUES, GAPS = 5, 8  # on either side of a gap, and how many gaps are looked at
CALMER = 0.5  # square sum of steps of decoded registers over that of what was logged


def without_registers(log: Dataset) -> tuple[Dataset, list[Doubt]]:
    """The log with torques as they were before registers without a sign held them, and what is said of registers."""
    found, u, follows = dict[tuple[str, str], list[str]](), log.u.copy(), consecutive(log)[:-1]
    for name, joint in ((name, joint) for name in "uq" for joint in range(log.nv)):
        x = getattr(log, name)[:, joint]
        levels = np.unique(x)
        if len(levels) < 2 * FEWEST_VALUES or levels[0] < 0.0:
            continue
        steps = np.diff(levels)
        end, ways = levels[-1] + steps.min(), dict[str, np.ndarray]()
        if name == "q" and abs(end - 2.0 * np.pi) < 0.5:  # an angle that wraps
            continue
        gaps = [at for at in np.argsort(-steps)[:GAPS] if FEWEST_VALUES <= at + 1 <= len(levels) - FEWEST_VALUES]
        for at in gaps:
            high, negative = x > levels[at], f"{levels[at + 1]:.4g} plus the magnitude where it is negative"
            ways[negative] = np.where(high, levels[at + 1] - x, x)
            ways.setdefault(f"{end:.4g} too much where it is negative", np.where(high, x - end, x))  # the widest gap
        moved = {way: float(np.square(np.diff(values))[follows].sum()) for way, values in ways.items()}
        if not moved:
            continue
        way = min(moved, key=moved.__getitem__)
        if moved[way] < CALMER * float(np.square(np.diff(x))[follows].sum()):
            found.setdefault((name, way), []).append(log.joint_names[joint])
            if name == "u":
                u[:, joint] = ways[way]
    doubts = [
        wrong(
            about="registers",
            what=f"the {QUANTITY[name]} of {listed(joints)} is never negative and jumps over a gap: a register as "
            f"it is stored, {way}.",
            do="Decode the register before the log is imported.",
            joints=tuple(joints),
            numbers={"quantity": name},
        )
        for (name, way), joints in found.items()
    ]
    return (replace(log, u=u, truth={}) if any(name == "u" for name, _ in found) else log), doubts


LONGEST_LAG, SAME_POSITION = 0.5, 0.98  # s, and the share of u that positions explain


def target_doubts(inputs: CheckInput) -> list[Doubt]:
    """Torques that are positions, a little ahead: the targets of a controller."""
    log, moves = inputs.even, np.ptp(inputs.even.q, axis=0) > 0.0
    if not inputs.log.time_ordered or not moves.any() or not (np.ptp(log.u, axis=0)[moves] > 0.0).all():
        return []
    step, rows = float(np.median(np.diff(log.time))), np.arange(len(log))
    for lag in np.unique(np.linspace(0.0, LONGEST_LAG / step, 51).astype(int)):
        own = rows[: len(rows) - lag][log.episode[: len(rows) - lag] == log.episode[lag:]]
        if len(own) < FROZEN_ROWS:
            break
        q, u = (x - x.mean(axis=0) for x in (log.q[own + lag][:, moves], log.u[own][:, moves]))
        slope = (q * u).sum(axis=0) / np.maximum(np.square(q).sum(axis=0), 1e-300)
        left = np.square(u - slope * q).sum(axis=0) / np.maximum(np.square(u).sum(axis=0), 1e-300)
        if (left < 1.0 - SAME_POSITION).all() and any(np.abs(slope / x - 1.0).max() < 0.1 for x in (1.0, 1.0 / DEGREE)):
            what = f"u is the position {1e3 * lag * step:.0f} ms later: these are targets of a controller, not torques."
            do = "Give the columns of measured torques or currents; without them masses and friction cannot be found."
            return [wrong(about="targets", what=what, do=do, joints=inputs.names, numbers={"lag": lag * step})]
    return []


def _jumps(inputs: CheckInput) -> Iterator[Doubt]:
    if inputs.jumps.any():
        row, joint = (int(index) for index in np.argwhere(inputs.jumps)[0])
        yield wrong(
            about="jumps",
            what=f"the position of {inputs.names[joint]} jumps by more than pi after row {row} at "
            f"{inputs.log.time[row]:.3f} s ({int(inputs.jumps.sum())} times in all), so that motion and torques were "
            "not checked.",
            do="Unwrap angles (forcegp import --unwrap, or np.unwrap(q, axis=0)), or convert degrees to radians.",
            joints=inputs.named(np.flatnonzero(inputs.jumps.any(axis=0))),
            numbers={"row": row, "count": int(inputs.jumps.sum())},
        )


def _dropped(inputs: CheckInput, kinds: Sequence[str]) -> Iterator[Doubt]:
    """Rows of a signal that were lost and read 0, and single ones that are far from those before and after."""
    time = inputs.log.time
    for about in kinds:
        lost = dict[str, np.ndarray]()
        for name, rows in inputs.dropped.items():
            own = rows & ((getattr(inputs.log, name)[:, : rows.shape[1]] == 0.0) == (about == "drop-outs"))
            lost |= {name: own} if own.any() else {}
        if not lost:
            continue
        every = np.any(list(lost.values()), axis=0)
        rows, names = np.flatnonzero(every.any(axis=1)), inputs.named(np.flatnonzero(every.any(axis=0)))
        seen = f"{len(rows)} rows ({100.0 * len(rows) / len(every):.2g} %) read exactly 0 between values far from 0"
        remedy = "They were not measured: leave these rows out, and look at the logger."
        if about == "spike":
            seen = f"{len(rows)} single value{'s' if len(rows) > 1 else ''} far from those just before and after"
            half = 0.5 * float(np.median(np.diff(time)))
            edges = (x for a, b in runs(every.any(axis=1)) for x in (time[a] - half, time[b - 1] + half))
            ends = ",".join(f"{x:.{FINE - int(np.log10(half))}f}" for x in edges)
            remedy = f"Such a value is wrong: leave it out, by forcegp import LOG --without {ends}."
        yield wrong(
            about=about,
            what=f"{seen}, in {listed(tuple(EVERY_QUANTITY[name] for name in lost))} of {listed(names)}; the first is "
            f"row {rows[0]} at {time[rows[0]]:.3f} s.",
            do=remedy,
            joints=names,
            numbers={"rows": len(rows), "row": int(rows[0]), "quantities": list(lost)},
        )


def _constant(inputs: CheckInput) -> Iterator[Doubt]:
    log = inputs.log
    rests, counts = _still(log, "v") & _still(log, "q") | _dithers(log), np.flatnonzero(_dithers(log))
    for name, quantity in QUANTITY.items():
        told = rests if name in "va" else False  # of its position
        values, dead = getattr(log, name), np.flatnonzero(_still(log, name) & np.logical_not(told))
        dead = np.union1d(dead, counts) if name == "q" else dead
        if not len(dead):
            continue
        names, all_of_them = inputs.named(dead), len(dead) == log.nv
        seen = f"the {quantity} of {listed(names)} never changes (it is {values[0, dead[0]] + 0.0:.6g} in every row)."
        if name == "q" and np.isin(dead, counts).all():
            seen = f"{listed(names)} stands still: its position changes by counts of its encoder alone."
        places = ",".join(f"{each}={log.q[:, k].mean() + 0.0:.4g}" for each, k in zip(names, dead, strict=True))
        remedy = f"Right for a joint that was held; then forcegp import --lock {places}. Else the channel is dead."
        passive = name == "u" and not values[:, dead].any()
        if name == "u":
            remedy = "Right for a passive mechanism; else the torque columns are missing."
        if passive and all_of_them:
            seen = "no torque was measured (every u is 0)."
        driven = (name == "u" or all_of_them) and _driven(inputs, dead)
        calm = (passive or all_of_them) and not driven
        level: Level = "look" if calm or rests[dead].all() else "wrong"
        more = {"joints": names, "numbers": {"quantity": name}}
        yield Doubt(level=level, about="constant channel", what=seen, do=remedy, **more)


def _driven(inputs: CheckInput, dead: np.ndarray) -> bool:
    """Whether the motion needs torques at these joints, unlike that of a mechanism that swings by itself."""
    if inputs.compared is None or inputs.contacts:
        return False
    rows = inputs.rows()
    needed = needed_torques(inputs.robot, rows)
    size = np.std(needed, axis=0)
    if len(dead) < len(size):
        return bool((size[dead] > NEEDED * np.delete(size, dead).max()).any())
    fixed = needed_torques(inputs.robot, replace(rows, a=0.0 * rows.a))
    return bool((size > PASSIVE * np.std(needed - fixed, axis=0)).any())


def _still(log: Dataset, name: str) -> np.ndarray:  # up to rounding
    values = getattr(log, name)
    return np.ptp(values, axis=0) <= ROUNDING * np.abs(values).max(initial=0.0)


COUNTS = 5.5  # steps of an encoder between which a joint that stands still may go to and fro


def _dithers(log: Dataset) -> np.ndarray:  # joints that stand still but for counts of their encoder
    spans = np.ptp(log.q, axis=0)
    counts = [span and span / resolution(x) for span, x in zip(spans, log.q.T, strict=True)]
    return (spans > 0.0) & (spans < np.where(log.turns, *STILL)) & (np.array(counts) < COUNTS)


def _frozen(inputs: CheckInput, name: str, joint: int) -> Iterator[Doubt]:
    """A channel that stands still, to the last digit, while the joint's other channels show that it moves."""
    log = inputs.log
    values, follows = getattr(log, name)[:, joint], consecutive(log)[:-1]
    held = np.diff(values) == 0
    rests = np.ptp(log.q[:, joint]) < np.where(log.turns, *STILL)[joint]  # by a controller that holds it, perhaps
    if np.ptp(values) == 0.0 or rests or not follows.any() or (name == "u" and held.mean() > HELD_STEPS):
        return
    others = np.any([np.diff(getattr(log, other)[:, joint]) != 0 for other in QUANTITY if other != name], axis=0)
    step = float(np.median(np.diff(log.time)[follows]))
    # a velocity that stands still at rest is right, also where the position is noisy; a joint that sticks while its
    # velocity is an estimate does not jump afterwards; and noise about rest goes nowhere
    speed = log.v[1:, joint] if name != "v" else np.where(follows, np.diff(log.q[:, joint]), 0.0) / step
    moves = np.abs(speed) > MOVES * np.sqrt(np.square(speed).mean())
    if name != "u":
        others &= np.diff(log.u[:, joint]) != 0  # at rest q and v stand still together, while u is noisy or not
    start, length, agrees = 0, 0, np.zeros(len(held), dtype=bool)
    if name == "v" and speed.any():  # where an encoder counts as many steps in each row, v is right to stand still
        slope = float(values[1:] @ speed / (speed @ speed))  # whatever the unit of v is
        agrees = np.abs(values[1:] - slope * speed) * step < AGREES * abs(slope) * resolution(log.q[:, joint])
    for begin, end in runs(held & follows).tolist():
        rows = end - begin
        if rows <= max(length, FROZEN_ROWS - 1) or rows * step < FROZEN_SECONDS or agrees[begin:end].all():
            continue
        gone = np.cumsum(speed[begin:end]) * step
        jump = abs(values[end + 1] - values[begin]) if end < len(held) else np.inf
        sticks = jump < 0.5 * abs(gone[-1]) if name == "q" else jump < STEPS * resolution(values)
        far = np.ptp(gone) > 0.25 * np.abs(speed[begin:end]).sum() * step
        least = 0.25 if name == "u" else 0.5  # a joint turns and rests while its torque does not
        if moves[begin:end].mean() > least and others[begin:end].mean() > 0.5 and far and not sticks:
            start, length = begin, end - begin
    if not length or values[start] in (values.min(), values.max()):
        return
    limit = name == "u" and (np.ptp(runs(values == values[start]), axis=1) >= FROZEN_ROWS).sum() > 1  # which recurs
    yield Doubt(
        level="look" if name == "u" and values[start] == 0.0 else "wrong",
        about="saturation" if limit else "frozen channel",
        what=f"the {QUANTITY[name]} of {inputs.names[joint]} stands still at {values[start]:.6g} for "
        f"{length * step:.3g} s from row {start} at {log.time[start]:.3f} s, while its other signals change.",
        do=f"Leave such stretches out, here by forcegp import LOG --without {log.time[start]:.2f},"
        f"{log.time[start] + length * step:.2f}, and look at the {'limits of the drive' if limit else 'logger'}.",
        joints=(inputs.names[joint],),
        numbers={"quantity": name, "row": start, "seconds": length * step},
    )


def _clipped(inputs: CheckInput) -> Iterator[Doubt]:
    """Torques of joints, or what sensors measured, that stay at their extremes while these joints, or any, move."""
    log, speed = inputs.log, np.abs(inputs.log.v)
    moves = speed > MOVES * np.sqrt(np.square(speed).mean(axis=0))
    channels = [(f"torque of {name}", (name,), log.u[:, j], moves[:, j]) for j, name in enumerate(inputs.names)]
    for name, values in log.measured.items():
        axes = "xyz" if len(values.T) == 3 else ("torque",)
        channels += [(f"sensor {name} ({axis})", (), x, moves.any(1)) for axis, x in zip(axes, values.T, strict=True)]
    for which, joints, values, moving in channels:
        for extreme, there in ends_of_range(values, moving):
            start, stop = max(runs(there).tolist(), key=lambda run: run[1] - run[0])
            at = int((there & moving).sum())
            if not joints and extreme == 0.0:  # nothing touches it
                continue
            yield wrong(
                about="saturation",
                what=f"the {which} stays at its {'largest' if extreme == values.max() else 'smallest'} value "
                f"{extreme:.5g} in {at} rows of motion; the longest stretch, {stop - start} rows, begins at row "
                f"{start} at {log.time[start]:.3f} s.",
                do="The robot received another torque than the log states, or the sensor is at its end: leave "
                "these stretches out, or move more gently.",
                joints=joints,
                numbers={"value": extreme, "rows": at, "row": start},
            )


OFTEN_REPEATED = 0.02  # share of rows in motion that repeat the one before: the logger had no new values


def sampling_doubts(inputs: CheckInput) -> Iterator[Doubt]:
    """Rate and duration; repeated rows."""
    log = inputs.log
    follows = consecutive(log)[:-1]
    steps = np.diff(log.time)[follows]
    if not len(steps):
        return
    median, count, seconds = float(np.median(steps)), len(log.episodes), float(steps.sum())
    each = f"{count} episodes" if count > 1 else "one episode"
    yield ok(
        about="sampling",
        what=f"{len(log)} rows in {each}, {seconds:.1f} s in all, {1.0 / median:.4g} Hz.",
        numbers={"sample_rate": 1.0 / median, "seconds": seconds, "episodes": count, "rows": len(log)},
    )
    # rows in which every position is that of the row before although velocities show that the robot moves
    same, speed = (np.diff(log.q, axis=0) == 0).all(axis=1) & follows, np.abs(log.v).max(axis=1)[1:]
    moves = speed > 0.1 * np.sqrt(np.square(speed).mean())
    share = float((same & moves).sum() / max(1, (moves & follows).sum()))
    if share < OFTEN_REPEATED:
        return
    row = int(np.argmax(same & moves)) + 1
    what = f"{100.0 * share:.2g} % of the rows in motion repeat all positions of the row before (the first: row "
    what += f"{row} at {log.time[row]:.3f} s): the logger runs faster than the robot's measurements."
    do = "Drop the repeated rows before anything is differentiated, or log at the robot's own rate."
    yield look(about="repeated rows", what=what, do=do, numbers={"share": share, "row": row})


RPM = np.pi / 30.0
FACTORS: dict[float, tuple[str, str | None]] = {
    1.0 / DEGREE: ("deg/s where q is in rad, or q in rad where v is in deg/s", "deg/s"),
    DEGREE: ("rad/s where q is in degrees", "rad/s"), 1.0 / RPM: ("rpm where q is in rad", "rpm"),
    1000.0: ("mrad/s", "mrad/s"), 0.001: ("per millisecond", None),
    0.5 / np.pi: ("turns per second where q is in rad", "rev/s"),
}  # fmt: skip
"""Ratios of v to dq/dt, what explains each, and the unit of v, where q is in rad but for that of degrees."""
SLIDING = {0.001: FACTORS[0.001], 100.0: ("cm/s", "cm/s"), 1000.0: ("mm/s", "mm/s")}

CLOSE = 0.05  # deviation from one of them, or from 1, that noise and filters explain
SURE = 0.025  # the same for some joints alone: gears of 1:10 and 1:60 are that close to rpm and deg/s
UNEXPLAINED = 0.3  # share of the power of v that dq/dt may leave unexplained, at the best factor and shift
FEW = 0.05  # share below which a factor is meant seriously
IDLE = 0.01  # of the largest of all joints, up to which what moves a joint may be noise
TINY_SPEED = 1e-20  # of the mean square velocity of all joints
SHIFTS = np.linspace(-0.05, 0.05, 101)  # s
LEAST_SHIFT = 1.2  # time steps by which v must be late or early to be reported


def motion_doubts(inputs: CheckInput, joints: Sequence[int] | None = None) -> list[Doubt]:
    """Factor, sign, delay and fit of v against dq/dt and of a against dv/dt, of all joints or of some."""
    if inputs.prepared is None:
        return []
    even, ends = inputs.even, preparation_report(inputs.prepared.metadata)["trim"]  # where a filter shows itself
    if inputs.cutoff is not None:  # all three signals by one filter: what it takes from one it takes from the others
        even = low_pass(even, float(inputs.cutoff), signals=("q", "v", "a"))
    joints = range(even.nv) if joints is None else joints
    imported = inputs.log.metadata.get("import")  # others may have put anything there
    made = imported.get("signals") if isinstance(imported, Mapping) else None
    derived = {x for x in "va" if isinstance(made, Mapping) and str(made.get(x)).startswith("central")}
    pieces = [even.select_episodes([number]) for number in even.episodes]
    found: list[Doubt] = []
    for name, source in (("v", "q"), ("a", "v")):
        if name in derived or any(doubt.level != "ok" for doubt in found):
            continue  # of wrong velocities nothing better can come, and what was derived says nothing
        slopes = np.concatenate([differentiate(getattr(rows, source), rows.time) for rows in pieces])
        size = np.sqrt([np.square(x).mean(axis=0) for x in (getattr(even, name), slopes)])
        kinds = ([k for k in joints if inputs.rotates[k] == inputs.rotates[joint]] for joint in joints)
        moved = [k for k, own in zip(joints, kinds, strict=True) if (size[:, k] > IDLE * size[:, own].max(1)).any()]
        compared = ((joint, _compared(pieces, name, source, joint, ends)) for joint in moved)
        fits = {joint: fit for joint, fit in compared if fit is not None}
        found += _differences(inputs, name, source, fits, joints)
        if not found and fits and name == "v":
            error = max(unexplained for _, _, unexplained in fits.values())
            seen = f"v is dq/dt in every joint (at most {100.0 * error:.2g} % of its power is not)."
            found.append(ok(about="velocity", what=seen, numbers={"unexplained": error}))
    return found


def _compared(
    pieces: list[Dataset], name: str, source: str, joint: int, ends: float = 0.0
) -> tuple[float, float, float] | None:
    """Factor, delay [s] and unexplained share of `name` against the derivative of `source`; None without motion."""
    left, right = [], []
    for rows in pieces:
        first, last = (rows.time[k] + side * max(SHIFTS[-1], ends) for k, side in ((0, 1.0), (-1, -1.0)))
        inner = (rows.time >= first) & (rows.time <= last)
        if inner.sum() >= 3:
            left.append(CubicSpline(rows.time, getattr(rows, name)[:, joint])(rows.time[inner] + SHIFTS[:, None]))
            right.append(differentiate(getattr(rows, source)[:, [joint]], rows.time)[inner, 0])
    if not left:
        return None
    values, slopes = np.concatenate(left, axis=1), np.concatenate(right)
    power, steep = np.square(values).sum(axis=1), float(np.square(slopes).sum())
    sizes = [float(np.square(getattr(rows, name)).mean()) for rows in pieces]
    if not min(steep, float(power.min())) > TINY_SPEED * max(*sizes, steep / len(slopes)) * len(slopes):
        return None  # a joint that stands still
    factor, unexplained = values @ slopes / steep, 1.0 - np.square(values @ slopes) / (steep * power)
    best = int(np.argmin(unexplained))
    return float(factor[best]), lowest(unexplained, SHIFTS), float(max(0.0, unexplained[best]))


def _differences(
    inputs: CheckInput, name: str, source: str, fits: Mapping[int, tuple[float, float, float]], of: Sequence[int]
) -> Iterator[Doubt]:
    """One doubt for all joints in which v or a differs from the derivative in the same way."""
    step = float(np.median(np.diff(inputs.even.time)))
    groups: dict[tuple[str, float, str, str | None], list[int]] = {}
    for joint, (factor, shift, left) in fits.items():
        late = np.isfinite(shift) and abs(shift) > max(LEAST_SHIFT * step, 5e-4)
        sort = "sign" if factor < 0.0 else "factor" if abs(factor - 1.0) > CLOSE else "late" if late else ""
        kind = "other" if left > UNEXPLAINED else sort if left < FEW else ""
        usual = FACTORS if inputs.rotates[joint] else SLIDING
        known = next((x for x in usual if abs(abs(factor) / x - 1.0) < CLOSE and kind in ("factor", "sign")), 0.0)
        guess, unit = usual.get(known if name == "v" else 0.0, ("", None))
        if kind:
            groups.setdefault((kind, known, guess, unit), []).append(joint)
    units = {x: inputs.stated_units(x) for x in "qv"}
    for (_, known, _, unit), joints in groups.items():
        if unit and (len(joints) == len(fits) or all(abs(abs(fits[k][0]) / known - 1.0) < SURE for k in joints)):
            signal, word = ("q", "deg") if known == DEGREE else ("v", unit)
            kin = {k for k in of if inputs.rotates[k] == inputs.rotates[joints[0]]}  # also those that stand still
            alike, si = kin if kin & fits.keys() <= {*joints} else joints, inputs.unit_of_each(signal)
            units[signal] = [word if k in alike and x == si[k] else x for k, x in enumerate(units[signal])]
    other = {x: tuple(own) for x, own in units.items() if own != inputs.stated_units(x)}
    for (kind, _, guess, unit), joints in groups.items():
        factor, shift, unexplained = fits[joints[0]]
        factors = [fits[joint][0] for joint in joints]
        named, every, what = inputs.named(joints), len(joints) == len(of) > 2, EVERY_QUANTITY[name]
        one = f"the {what} of {'all joints' if every else listed(named)} is"
        guess = unit if unit and inputs.stated_units("q")[joints[0]] != inputs.unit_of_each("q")[joints[0]] else guess
        level: Level = "wrong"
        if kind == "other":
            level = "look" if name == "a" else "wrong"
            seen = f"{one} not d{source}/dt: {100.0 * unexplained:.0f} % of its power is something else."
            remedy = f"Check which column {name} was read from; or leave it out, so that it is computed from {source}."
        elif kind == "sign":
            seen = f"{one} of the opposite sign of d{source}/dt (factor {factor:.3g})."
            remedy = f"Turn the sign of {name} or of {source} for this joint, whichever is wrong."
        elif kind == "factor":
            level = "wrong" if abs(factor - 1.0) > 4 * CLOSE else "look"
            seen = f"{one} {factor:.4g} times d{source}/dt{guess and f': {name} looks like {guess}'}."
            remedy = f"Convert {name} or {source} to SI units, or remove the gear ratio."
            if name == "v" and not guess and len(joints) == len(of) > 1 and max(factors) - min(factors) < SURE:
                remedy = f"All joints share it: divide the time by it, if a clock or a rate is wrong. {remedy}"
                what = "clock" if level == "look" else what
        else:
            level, size = "look", f"{1e3 * abs(shift):.1f} ms {'later' if shift > 0 else 'earlier'}"
            seen = f"{one} logged {size} than d{source}/dt: {abs(shift) / step:.1f} time steps."
            remedy = f"The robot filtered it: compute {name} from positions (forcegp import --cutoff auto)."
        if max(factors) - min(factors) >= CLOSE * abs(factor):
            seen += f" Factors: {', '.join(f'{each:.3g}' for each in factors)}."
        correction: dict[str, Any] = {"unit": other} if unit and other else {}
        if name == "v" and kind == "sign" and (unit or abs(factor + 1.0) < CLOSE):
            correction |= {"sign": {"v": tuple(-1.0 if each in named else 1.0 for each in inputs.names)}}
        each = [
            {"quantity": name, "factor": f, "delay": s if np.isfinite(s) else None, "unexplained": left}
            for f, s, left in (fits[joint] for joint in joints)
        ]
        numbers = each[0] if len(each) == 1 else {"each": each}
        told = {"about": what, "what": seen, "do": remedy, "joints": named, "numbers": numbers}
        yield Doubt(level=level, **told, correction=correction)
