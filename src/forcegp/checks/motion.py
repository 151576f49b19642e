"""Are the rows even in time, and do q, v and a belong to each other."""

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from forcegp.checks.check_input import DEGREE, GAP, CheckInput, Finding, import_flags, listed, look, ok
from forcegp.data import Dataset, differentiate, low_pass
from forcegp.data.delay import lowest
from forcegp.data.filtering import JITTER
from forcegp.data.row_selection import consecutive

LOST = 1.8  # median steps at which at least one sample is missing
MUCH_LOST = 0.01  # share of the time in gaps that is a reason to look at the logger
LITTLE_LOST = 1e-4  # share that every logger loses
VERY_UNEVEN = 2.0  # deviation of a step from the median, relative to it: samples were lost
OFTEN_REPEATED = 0.02  # share of rows in motion that repeat the one before: the logger had no new values


def sampling_findings(inputs: CheckInput) -> Iterator[Finding]:
    """Rate and duration; jitter; lost samples and gaps; repeated rows; what importing had to mend."""
    log = inputs.log
    steps = np.diff(log.time)[consecutive(log)[:-1]]
    if not len(steps):
        return
    median = float(np.median(steps))
    count = len(log.episodes)
    each = f"{count} episodes" if count > 1 else "one episode"
    seconds = float(steps.sum())
    yield ok(
        subject="sampling",
        seen=f"{len(log)} rows in {each}, {seconds:.1f} s in all, {1.0 / median:.4g} Hz.",
        numbers={"sample_rate": 1.0 / median, "seconds": seconds, "episodes": count, "rows": len(log)},
    )
    yield from _lost(inputs, steps, median)
    regular = steps[steps < LOST * median]
    spread = float(np.abs(regular - median).max()) / median
    if spread > JITTER:
        yield look(
            subject="jitter",
            seen=f"time steps lie between {1e3 * regular.min():.3g} and {1e3 * regular.max():.3g} ms about the "
            f"median {1e3 * median:.3g} ms.",
            remedy="Use the recorded time stamps, never row numbers, and resample to even steps before filtering "
            "(forcegp import does).",
            numbers={"relative_deviation": spread},
        )
    yield from _repeated(inputs)
    with contextlib.suppress(AttributeError, TypeError, ValueError):  # somebody else's metadata
        yield from _imported(log.metadata)


def _lost(inputs: CheckInput, steps: np.ndarray, median: float) -> Iterator[Finding]:
    log = inputs.log
    long = steps > LOST * median
    if not long.any():
        return
    first_rows = np.flatnonzero(consecutive(log))
    worst = int(first_rows[np.argmax(steps)])
    lost = float((steps[long] - median).sum())
    share = lost / float(steps.sum())
    gaps = int((steps > GAP * median).sum())
    yield Finding(
        severity="wrong" if share > MUCH_LOST else "look" if gaps or share > LITTLE_LOST else "ok",
        subject="lost samples",
        seen=f"{int(long.sum())} steps are longer than {LOST} medians ({100.0 * share:.2g} % of the time is not "
        f"recorded); the longest, {1e3 * steps.max():.3g} ms, is after row {worst} at {log.time[worst]:.3f} s"
        + (f"; {gaps} of them are gaps of more than {GAP:g} steps." if gaps else "."),
        remedy=""
        if share <= LITTLE_LOST and not gaps
        else "A derivative across a gap is no acceleration: split the log there (forcegp import does), and look "
        "why the logger loses samples.",
        numbers={"count": int(long.sum()), "gaps": gaps, "share": share, "row": worst, "time": log.time[worst]},
    )


def _repeated(inputs: CheckInput) -> Iterator[Finding]:
    """Rows in which every position is that of the row before although velocities show that the robot moves."""
    log = inputs.log
    follows = consecutive(log)[:-1]
    same = (np.diff(log.q, axis=0) == 0).all(axis=1) & follows
    speed = np.abs(log.v).max(axis=1)[1:]
    moves = speed > 0.1 * np.sqrt(np.square(speed).mean())
    share = float((same & moves).sum() / max(1, (moves & follows).sum()))
    if share < OFTEN_REPEATED:
        return
    row = int(np.flatnonzero(same & moves)[0]) + 1
    yield look(
        subject="repeated rows",
        seen=f"{100.0 * share:.2g} % of the rows in motion repeat all positions of the row before (the first: row "
        f"{row} at {log.time[row]:.3f} s): the logger runs faster than the robot's measurements.",
        remedy="Drop the repeated rows before anything is differentiated, or log at the robot's own rate.",
        numbers={"share": share, "row": row},
    )


def _imported(metadata: Mapping[str, Any]) -> Iterator[Finding]:
    """What `forcegp import` found in the log files and repaired, from `metadata["import"]`."""
    report = metadata.get("import")
    if not isinstance(report, Mapping) or not report.get("recordings"):
        return
    logs = report["recordings"]
    repeated = sum(item.get("repeated_stamps_dropped", 0) for item in logs)
    gaps = sum(len(item.get("gaps", ())) for item in logs)
    uneven = max(float(item.get("largest_deviation_of_a_step", 0.0)) for item in logs)
    met = [f"{repeated} repeated time stamps (dropped)"] if repeated else []
    met += [f"{gaps} gaps (split there)"] if gaps else []
    if report.get("resampled_to_step") is not None and uneven > JITTER:
        met.append(f"time steps up to {100.0 * uneven:.0f} % off their median (resampled)")
    if not met:
        return
    often = gaps > 0 or repeated > 0 or uneven > VERY_UNEVEN
    yield Finding(
        severity="look" if often else "ok",
        subject="import",
        seen=f"importing {'the log' if len(logs) == 1 else f'{len(logs)} logs'} met {', '.join(met)}.",
        remedy="Nothing is left to do in this dataset; look at the logger." if often else "",
        numbers={"repeated_stamps": repeated, "gaps": gaps, "largest_deviation_of_a_step": uneven},
    )


RPM = np.pi / 30.0
FACTORS = {
    1.0 / DEGREE: "deg/s where q is in rad, or q in rad where v is in deg/s",
    DEGREE: "rad/s where q is in degrees",
    1.0 / RPM: "rpm where q is in rad",
    1000.0: "mrad/s",
    0.001: "per millisecond",
    1.0 / (2.0 * np.pi): "turns per second where q is in rad",
}
"""Ratios of v to dq/dt, and the unit of v that explains each."""

UNITS = {1.0 / DEGREE: "deg/s", 1.0 / RPM: "rpm", 1000.0: "mrad/s", 0.5 / np.pi: "rev/s"}
"""Of them those that `forcegp import --unit v=` takes where q is in rad."""

CLOSE = 0.05  # deviation from one of them, or from 1, that noise and filters explain
UNEXPLAINED = 0.3  # share of the power of v that dq/dt may leave unexplained, at the best factor and shift
FEW = 0.05  # share below which a factor is meant seriously
ROUNDING = 1e-20  # of the mean square velocity of all joints
SHIFTS = np.linspace(-0.05, 0.05, 101)  # s
LEAST_SHIFT = 1.2  # time steps by which v must be late or early to be reported


def motion_findings(inputs: CheckInput) -> list[Finding]:
    """Factor, sign, delay and fit of v against dq/dt and of a against dv/dt, joint by joint."""
    if inputs.prepared is None:
        return []
    cutoff = inputs.prepared.preparation.cutoff
    even = inputs.even
    if cutoff is not None:  # all three signals by one filter: what it takes from one it takes from the others
        even = low_pass(even, float(cutoff), signals=("q", "v", "a"))
    pieces = [even.select_episodes([number]) for number in even.episodes]
    found = []
    for name, source, what, derivative in (("v", "q", "velocity", "dq/dt"), ("a", "v", "acceleration", "dv/dt")):
        if name == "a" and any(finding.severity != "ok" for finding in found):
            break  # of wrong velocities nothing better can come
        compared = ((joint, _compared(pieces, name, source, joint)) for joint in range(even.nv))
        fits = {joint: fit for joint, fit in compared if fit is not None}
        findings = [_finding(inputs, fit, joint, name, what, derivative) for joint, fit in fits.items()]
        found += _merged([item for item in findings if item is not None], inputs.names)
        if not found and fits and name == "v":
            error = max(unexplained for _, _, unexplained in fits.values())
            seen = f"v is dq/dt in every joint (at most {100.0 * error:.2g} % of its power is not)."
            found.append(ok(subject="velocity", seen=seen, numbers={"unexplained": error}))
    return found


def _compared(pieces: list[Dataset], name: str, source: str, joint: int) -> tuple[float, float, float] | None:
    """Factor, delay [s] and unexplained share of `name` against the derivative of `source`; None without motion."""
    left, right = [], []
    for rows in pieces:
        inner = (rows.time >= rows.time[0] + SHIFTS[-1]) & (rows.time <= rows.time[-1] + SHIFTS[0])
        if inner.sum() < 3:
            continue
        left.append(CubicSpline(rows.time, getattr(rows, name)[:, joint])(rows.time[inner] + SHIFTS[:, None]))
        right.append(differentiate(getattr(rows, source)[:, [joint]], rows.time)[inner, 0])
    if not left:
        return None
    values, slopes = np.concatenate(left, axis=1), np.concatenate(right)
    power = np.square(values).sum(axis=1)
    sizes = [float(np.square(getattr(rows, name)).mean()) for rows in pieces]
    least = ROUNDING * max(*sizes, float(np.square(slopes).mean())) * len(slopes)
    if not np.square(slopes).sum() > least or not power.min() > least:
        return None  # a joint that stands still
    factor = values @ slopes / np.square(slopes).sum()
    unexplained = 1.0 - np.square(values @ slopes) / (np.square(slopes).sum() * power)
    best = int(np.argmin(unexplained))
    return float(factor[best]), lowest(unexplained, SHIFTS), float(max(0.0, unexplained[best]))


def _finding(
    inputs: CheckInput, fit: tuple[float, float, float], joint: int, name: str, what: str, derivative: str
) -> Finding | None:
    factor, shift, unexplained = fit
    label, source = inputs.names[joint], "q" if name == "v" else "v"
    numbers = {"quantity": name, "factor": factor, "delay": shift if np.isfinite(shift) else None}
    about = partial(Finding, subject=what, joints=(label,), numbers={**numbers, "unexplained": unexplained})
    if unexplained > UNEXPLAINED:
        return about(
            severity="wrong" if name == "v" else "look",
            seen=f"the {what} of {label} is not {derivative}: {100.0 * unexplained:.0f} % of its power is something "
            "else.",
            remedy=f"Check which column {name} was read from; or leave it out, so that it is computed from {source}.",
        )
    if unexplained < FEW and factor < 0.0:
        return about(
            severity="wrong",
            seen=f"the {what} of {label} has the opposite sign of {derivative} (factor {factor:.3g}).",
            remedy=f"Turn the sign of {name} or of {source} for this joint, whichever is wrong.",
        )
    if unexplained < FEW and abs(factor - 1.0) > CLOSE:
        unit = next((unit for known, unit in FACTORS.items() if abs(factor / known - 1.0) < CLOSE), None)
        guess = f": {name} looks like {unit}" if unit and name == "v" else ""
        return about(
            severity="wrong" if abs(factor - 1.0) > 4 * CLOSE else "look",
            seen=f"the {what} of {label} is {factor:.4g} times {derivative}{guess}.",
            remedy=f"Convert {name} or {source} to SI units, or remove the gear ratio.",
        )
    step = float(np.median(np.diff(inputs.even.time)))
    if unexplained < FEW and np.isfinite(shift) and abs(shift) > max(LEAST_SHIFT * step, 5e-4):
        return about(
            severity="look",
            seen=f"the {what} of {label} is logged {1e3 * abs(shift):.1f} ms {'later' if shift > 0 else 'earlier'} "
            f"than {derivative}: {abs(shift) / step:.1f} time steps.",
            remedy=f"It was filtered by the robot: compute {name} from positions (forcegp prepare --cutoff auto "
            "--differentiate q).",
        )
    return None


def _merged(findings: list[Finding], names: tuple[str, ...]) -> list[Finding]:
    """One finding for all joints where they are the same."""
    kinds: dict[tuple, list[Finding]] = {}
    for item in findings:
        factor = item.numbers["factor"]
        kind = next((known for known in FACTORS if abs(factor / known - 1.0) < CLOSE), None) or np.sign(factor)
        kinds.setdefault((item.severity, item.subject, item.remedy, kind), []).append(item)
    merged = []
    for group in kinds.values():
        first = group[0]
        joints = tuple(name for item in group for name in item.joints)
        every = joints == names and len(names) > 2
        seen = first.seen.replace(first.joints[0], "all joints" if every else listed(joints))
        factors = [item.numbers["factor"] for item in group]
        alike = max(factors) - min(factors) < CLOSE * abs(factors[0])
        each = "" if alike else f" Factors: {', '.join(f'{factor:.3g}' for factor in factors)}."
        numbers = {"each": [dict(item.numbers) for item in group]} if group[1:] else first.numbers
        correction = _correction(first, joints, names)
        flags = import_flags(correction)
        remedy = f"forcegp import {flags}; or {first.remedy[0].lower()}{first.remedy[1:]}" if flags else first.remedy
        more = {"seen": f"{seen}{each}" if group[1:] else first.seen, "remedy": remedy, "correction": correction}
        merged.append(replace(first, joints=joints, numbers=numbers, **more))
    return merged


def _correction(first: Finding, joints: tuple[str, ...], names: tuple[str, ...]) -> dict[str, Any]:
    """The unit or sign of v of these joints that would make it dq/dt; nothing where that is not the mistake."""
    factor = first.numbers["factor"]
    if first.severity != "wrong" or first.subject != "velocity" or first.numbers["unexplained"] > FEW:
        return {}
    if abs(factor + 1.0) < CLOSE:
        return {"sign": {"v": tuple(-1.0 if name in joints else 1.0 for name in names)}}
    unit = next((unit for known, unit in UNITS.items() if abs(factor / known - 1.0) < CLOSE), None)
    return {"unit": {"v": (unit,)}} if unit is not None and joints == names else {}
