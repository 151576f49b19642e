"""What noise of the acceleration is left by the filter, and what it means in Nm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from forcegp.checks.check_input import CheckInput
from forcegp.checks.findings import Finding, look, ok, plain
from forcegp.checks.successive_rows import white_noise

MUCH = 0.2
"""Noise relative to the spread of the signal from which a filter is worth its name."""


STATED_OFF = 3.0
"""Factor either way between stated and seen noise of the acceleration that is reported."""

FAR_OFF = 10.0

LARGE_TORQUE = 0.5
"""Noise times M, relative to the spread of the torque."""


def stated_noise_findings(inputs: CheckInput) -> list[Finding]:
    """`noise_std` against the noise that the acceleration of successive rows shows."""
    log = inputs.log
    stated, seen = log.noise_level, white_noise(log)
    if stated is None or seen is None:
        return []
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = seen / stated
    off = np.flatnonzero((ratio > STATED_OFF) | (ratio < 1.0 / STATED_OFF))
    if not len(off):
        return []
    joint = int(off[np.argmax(np.abs(np.log(ratio[off])))])
    small = ratio[joint] > 1.0
    return [
        Finding(
            severity="wrong" if ratio[joint] > FAR_OFF else "look",
            subject="noise_std",
            seen=f"noise_std states {stated[joint]:.3g} for the acceleration of {inputs.names[joint]}; successive rows "
            f"show noise of {seen[joint]:.3g}: {ratio[joint] if small else 1.0 / ratio[joint]:.3g} times as "
            f"{'much' if small else 'little'}.",
            remedy="Learn it (forcegp fit --noise learned), or state what was measured."
            + ("" if small else " Noise that a filter made smooth does not show between rows: then leave it."),
            joints=tuple(inputs.names[k] for k in off),
            numbers={"stated": plain(stated), "seen": plain(seen)},
        )
    ]


def noise_findings(inputs: CheckInput) -> list[Finding]:
    """Noise of the acceleration before and after the filter, in rad/s^2 and, with the mass matrix, in Nm."""
    if inputs.prepared is None:
        return []
    report = inputs.price
    cutoff = report.get("cutoff")
    measured = report.get("acceleration_noise", {})
    if cutoff is None or any(len(measured.get(when, ())) != len(inputs.names) for when in ("before", "after")):
        return [ok(subject="noise", seen="the positions show no noise worth a filter.")]
    before, after = (numbers_of(measured[when]) for when in ("before", "after"))
    spread = np.std(inputs.prepared.dataset.a, axis=0)
    why = "where the spectrum shows the end of the motion" if inputs.automatic else "as asked for"
    if report is not inputs.prepared.report:
        why = "when this dataset was prepared"
    found = []
    if np.isfinite(after).any():
        worst = int(np.nanargmax(after / np.maximum(spread, 1e-300)))
        unit = "rad/s²" if inputs.rotates[worst] else "m/s²"
        found.append(
            ok(
                subject="noise",
                seen=f"a filter at {cutoff:.3g} Hz ({why}) takes the noise of the acceleration of "
                f"{inputs.names[worst]}, the worst, from {before[worst]:.3g} to {after[worst]:.2g} {unit}.",
                numbers={"cutoff": cutoff, "before": plain(before), "after": plain(after)},
            )
        )
    raw = "preparation" not in inputs.log.metadata
    with np.errstate(invalid="ignore"):
        loud = np.flatnonzero(before > MUCH * spread)
        left = np.flatnonzero(after > MUCH * spread)
    if raw and len(loud) and _measured_noise(inputs, loud):
        names = tuple(inputs.names[joint] for joint in loud)
        found.append(
            look(
                subject="noise",
                seen=f"the acceleration in this dataset is not filtered: its noise is up to "
                f"{np.max(before[loud] / spread[loud]):.2g} "
                "times the acceleration itself.",
                remedy=f"forcegp prepare DATA --cutoff {cutoff:.3g} --out prepared.h5 before learning from it.",
                joints=names,
            )
        )
    found += _in_torques(inputs, after)
    if len(left):
        names = tuple(inputs.names[joint] for joint in left)
        found.append(
            look(
                subject="noise",
                seen=f"even filtered, noise makes up more than {100 * MUCH:.0f} % of the acceleration of "
                f"{', '.join(names)}.",
                remedy="Move faster, filter lower, or learn from torques instead of accelerations.",
                joints=names,
            )
        )
    return found


def _in_torques(inputs: CheckInput, after: np.ndarray) -> list[Finding]:
    """Noise of the acceleration that is as large as the torques when multiplied by M."""
    assert inputs.prepared is not None
    noise = torque_noise(inputs, after)
    if noise is None or inputs.contacts:
        return []
    spread = np.std(inputs.prepared.dataset.u, axis=0)
    with np.errstate(invalid="ignore"):
        loud = np.flatnonzero((noise > LARGE_TORQUE * spread) & (spread > 0.0))
    if not len(loud):
        return []
    text = ", ".join(f"{inputs.names[k]} {noise[k]:.2g} of {spread[k]:.2g}" for k in loud)
    return [
        look(
            subject="noise",
            seen=f"even filtered, the noise of the acceleration is worth more than half of a torque: {text} Nm or N.",
            remedy="Filter lower for anything that compares torques (identification by torques); a likelihood of "
            "accelerations bears it.",
            joints=tuple(inputs.names[joint] for joint in loud),
            numbers={"noise": plain(noise[loud]), "torque": plain(spread[loud])},
        )
    ]


def _measured_noise(inputs: CheckInput, joints: np.ndarray) -> bool:
    """Whether the accelerations of the log are really that noisy: a log may hold better ones than differences."""
    assert inputs.prepared is not None
    spread = np.std(inputs.prepared.dataset.a, axis=0)[joints]
    return bool((np.std(inputs.log.a, axis=0)[joints] > 1.0 * np.hypot(1.0, MUCH) * spread).any())


def torque_noise(inputs: CheckInput, noise: np.ndarray) -> np.ndarray | None:
    """Standard deviation of M times the noise of a [Nm or N]."""
    if inputs.robot is None:
        return None
    with torch.no_grad():
        M = inputs.robot.mass_matrix(torch.tensor(inputs.rows().q, device=inputs.robot.device)).cpu().numpy()
    return np.sqrt(np.square(M).mean(axis=0) @ np.square(noise))


def numbers_of(values: Sequence[float | None]) -> np.ndarray:
    """Numbers from a report, NaN where it has none."""
    return np.array([np.nan if value is None else value for value in values], dtype=float)
