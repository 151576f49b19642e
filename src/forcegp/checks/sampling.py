"""Is the log sampled often and evenly enough: rate, jitter, gaps, repeated rows."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from forcegp.checks.check_input import GAP, CheckInput
from forcegp.checks.findings import Finding, look, ok
from forcegp.checks.successive_rows import consecutive
from forcegp.data.filtering import JITTER

LOST = 1.8
"""Median steps at which at least one sample is missing."""

MUCH_LOST = 0.01
"""Share of the time in gaps that is a reason to look at the logger."""

LITTLE_LOST = 1e-4
"""Share that every logger loses."""

VERY_UNEVEN = 2.0
"""Deviation of a step from the median, relative to it: samples were lost."""

OFTEN_REPEATED = 0.02
"""Share of rows that repeat the one before while the robot moves, which a logger without new values leaves."""


def sampling_findings(inputs: CheckInput) -> list[Finding]:
    """Rate and duration; jitter; lost samples and gaps; repeated rows; what importing had to mend."""
    log = inputs.log
    steps = np.diff(log.time)[consecutive(log)[:-1]]
    if not len(steps):
        return []
    median = float(np.median(steps))
    count = len(log.episodes)
    each = f"{count} episodes" if count > 1 else "one episode"
    seconds = float(steps.sum())
    numbers = {"sample_rate": 1.0 / median, "seconds": seconds, "episodes": count, "rows": len(log)}
    found = [
        ok(
            subject="sampling",
            seen=f"{len(log)} rows in {each}, {seconds:.1f} s in all, {1.0 / median:.4g} Hz.",
            numbers=numbers,
        )
    ]
    found += _lost(inputs, steps, median)
    regular = steps[steps < LOST * median]
    spread = float(np.abs(regular - median).max()) / median
    if spread > JITTER:
        found.append(
            look(
                subject="jitter",
                seen=f"time steps lie between {1e3 * regular.min():.3g} and {1e3 * regular.max():.3g} ms about the "
                f"median {1e3 * median:.3g} ms.",
                remedy="Use the recorded time stamps, never row numbers, and resample to even steps before filtering "
                "(forcegp import does).",
                numbers={"relative_deviation": spread},
            )
        )
    found += _repeated(inputs)
    with contextlib.suppress(AttributeError, TypeError, ValueError):  # somebody else's metadata
        found += _imported(log.metadata)
    return found


def _lost(inputs: CheckInput, steps: np.ndarray, median: float) -> list[Finding]:
    log = inputs.log
    long = steps > LOST * median
    if not long.any():
        return []
    first_rows = np.flatnonzero(consecutive(log))
    worst = int(first_rows[np.argmax(steps)])
    lost = float((steps[long] - median).sum())
    share = lost / float(steps.sum())
    gaps = int((steps > GAP * median).sum())
    return [
        Finding(
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
    ]


def _repeated(inputs: CheckInput) -> list[Finding]:
    """Rows in which every position is that of the row before although velocities show that the robot moves."""
    log = inputs.log
    follows = consecutive(log)[:-1]
    same = (np.diff(log.q, axis=0) == 0).all(axis=1) & follows
    speed = np.abs(log.v).max(axis=1)[1:]
    moves = speed > 0.1 * np.sqrt(np.square(speed).mean())
    share = float((same & moves).sum() / max(1, (moves & follows).sum()))
    if share < OFTEN_REPEATED:
        return []
    row = int(np.flatnonzero(same & moves)[0]) + 1
    return [
        look(
            subject="repeated rows",
            seen=f"{100.0 * share:.2g} % of the rows in motion repeat all positions of the row before (the first: row "
            f"{row} at {log.time[row]:.3f} s): the logger runs faster than the robot's measurements.",
            remedy="Drop the repeated rows before anything is differentiated, or log at the robot's own rate.",
            numbers={"share": share, "row": row},
        )
    ]


def _imported(metadata: Mapping[str, Any]) -> list[Finding]:
    """What `forcegp import` found in the log files and repaired, from `metadata["import"]`."""
    report = metadata.get("import")
    if not isinstance(report, Mapping) or not report.get("recordings"):
        return []
    logs = report["recordings"]
    repeated = sum(item.get("repeated_stamps_dropped", 0) for item in logs)
    gaps = sum(len(item.get("gaps", ())) for item in logs)
    uneven = max(float(item.get("largest_deviation_of_a_step", 0.0)) for item in logs)
    met = [f"{repeated} repeated time stamps (dropped)"] if repeated else []
    met += [f"{gaps} gaps (split there)"] if gaps else []
    if report.get("resampled_to_step") is not None and uneven > JITTER:
        met.append(f"time steps up to {100.0 * uneven:.0f} % off their median (resampled)")
    if not met:
        return []
    often = gaps > 0 or repeated > 0 or uneven > VERY_UNEVEN
    return [
        Finding(
            severity="look" if often else "ok",
            subject="import",
            seen=f"importing {'the log' if len(logs) == 1 else f'{len(logs)} logs'} met {', '.join(met)}.",
            remedy="Nothing is left to do in this dataset; look at the logger." if often else "",
            numbers={"repeated_stamps": repeated, "gaps": gaps, "largest_deviation_of_a_step": uneven},
        )
    ]
