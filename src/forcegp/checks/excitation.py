"""Does the motion show what is to be learned: base parameters, velocities of both signs, range of each joint."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from forcegp.analytical.identifiability import base_parameters, excitation
from forcegp.checks.check_input import CheckInput
from forcegp.checks.findings import Finding, listed, look
from forcegp.errors import InvalidInput

WELL = 100.0
"""Condition number up to which identification is commonly called well excited (Gautier & Khalil 1992)."""

BADLY = 1000.0
HYSTERESIS = 0.1
"""Of the root mean square velocity, beyond which a sign counts."""

FEWEST_CHANGES = 2
HELD = 0.02
"""Range of a joint in one stretch, relative to its largest, below which it was held there."""

STILL = {True: 0.02, False: 0.002}
"""Range in rad or m below which a joint does not move."""


def excitation_findings(inputs: CheckInput) -> list[Finding]:
    """Joints that hardly move or never turn back, and how well base parameters are determined."""
    if inputs.prepared is None:
        return []
    rows = inputs.prepared.dataset
    still, one_way, motions = [], [], []
    for joint, name in enumerate(inputs.names):
        v = rows.v[:, joint]
        size = float(np.sqrt(np.square(v).mean()))
        signs = np.sign(v[np.abs(v) > HYSTERESIS * size])
        changes = int((np.diff(signs) != 0).sum())
        span = float(np.ptp(rows.q[:, joint]))
        motions.append({"joint": name, "range": span, "rms_velocity": size, "sign_changes": changes})
        if span < STILL[bool(inputs.rotates[joint])]:
            still.append(name)
        elif changes < FEWEST_CHANGES:
            one_way.append(name)
    whose = "its" if len(still) == 1 else "their"
    idle = f"moved less than 0.02 rad (2 mm): {whose} friction and inertia do not show."
    turned = "changed direction less than twice: friction of both directions cannot be separated from gravity."
    found = [
        look(
            subject="excitation",
            seen=f"{listed(joints)} {what}",
            remedy=remedy,
            joints=tuple(joints),
            numbers={"joints": motions},
        )
        for joints, what, remedy in (
            (still, idle, "Move every joint that is to be learned, or lock it in the robot (`locked`)."),
            (one_way, turned, "Record motion to and fro."),
        )
        if joints
    ]
    return [*found, *_held(inputs, still), *_base_parameters(inputs)]


def _held(inputs: CheckInput, still: list[str]) -> Iterator[Finding]:
    """Joints that stand still in whole stretches although they move in others."""
    assert inputs.prepared is not None
    rows = inputs.prepared.dataset
    if len(rows.episodes) < 2:
        return
    spans = np.stack([np.ptp(rows.q[rows.episode == number], axis=0) for number in rows.episodes])
    for joint, name in enumerate(inputs.names):
        held = np.flatnonzero(
            (spans[:, joint] < HELD * spans[:, joint].max()) & (spans.max(axis=1) > 5.0 * spans[:, joint])
        )
        if name in still or not len(held) or len(held) > len(spans) // 2:
            continue
        first = int(held[0])
        unit = "rad" if inputs.rotates[joint] else "m"
        begin = float(rows.time[rows.episode == rows.episodes[first]][0])
        yield look(
            subject="held joint",
            seen=f"{name} stays within {spans[first, joint]:.2g} {unit} in {len(held)} of {len(spans)} stretches "
            f"while other joints move (the first: number {first}, counted from 0, at {begin:.3f} s); elsewhere it "
            f"moves {spans[:, joint].max():.2g}.",
            remedy="It was held, or sticks: leave the stretch out, or describe it as a constraint or another robot "
            "(`locked`).",
            joints=(name,),
            numbers={"stretches": held.tolist(), "range": float(spans[first, joint])},
        )


def _base_parameters(inputs: CheckInput) -> list[Finding]:
    if inputs.robot is None:
        return []
    rows = inputs.rows()
    try:
        seen = excitation(inputs.robot, rows.q, rows.v, rows.a)
    except InvalidInput:  # nothing moves and nothing weighs
        return []
    every = base_parameters(inputs.robot)
    numbers = {"condition": seen.condition, "seen": seen.rank, "base_parameters": every.rank}
    size = f"condition number {seen.condition:.3g} of {seen.rank} base parameters"
    if seen.rank < every.rank:
        return [
            look(
                subject="excitation",
                seen=f"{size}; {every.rank - seen.rank} more of this robot never show in this motion.",
                remedy="Identify few parameters, or record a motion of all joints at once.",
                numbers=numbers,
            )
        ]
    severity = "ok" if seen.condition <= BADLY else "look"
    quality = "well excited" if seen.condition <= WELL else "usable" if severity == "ok" else "poorly excited"
    return [
        Finding(
            severity=severity,
            subject="excitation",
            seen=f"{size}: {quality} (below {WELL:g} is good).",
            remedy=""
            if severity == "ok"
            else "Inertias of single links will be uncertain; record faster motion of all "
            "joints at once, and keep the URDF's values where the data are not informative.",
            numbers=numbers,
        )
    ]
