"""Cheap questions to what was read, so that a wrong unit is found before anything is learned from it."""

from __future__ import annotations

import warnings

import numpy as np

import forcegp.robots
from forcegp.errors import DatasetError, DataWarning
from forcegp.recordings.reading import RawRecording
from forcegp.recordings.signal_plan import SignalPlan

BEYOND = 0.1
"""Of its range: how far a position may be beyond the limits of the URDF. Stops give way, and zeros are set by hand."""

TURNS = 4.0 * np.pi
"""rad: positions of a joint beyond this whose unit is not stated as rad are taken for degrees."""

STRONGER = 3.0
"""Times the limit of the URDF that a force may be before it is warned of."""


def require_plausible_positions(
    recording: RawRecording, plan: SignalPlan, robot: forcegp.robots.Robot | None, stated: bool
) -> None:
    """Refuse positions far beyond the limits of the URDF; without a robot, those that look like degrees.

    `stated`: the unit of q was given, which is then believed where no URDF contradicts it.
    Raises DatasetError naming the joint, its range and what to do.
    """
    limits = {} if robot is None else {joint.name: (joint.lower, joint.upper) for joint in robot.joints}
    for index, item in enumerate(plan.signals):
        if item.signal != "q":
            continue
        low, high = recording.lowest[index], recording.highest[index]
        lower, upper = limits.get(item.joint, (-np.inf, np.inf))
        margin = BEYOND * (upper - lower) if np.isfinite(upper - lower) else 0.0
        beyond = low < lower - margin or high > upper + margin
        degrees = item.unit.name == "rad" and max(-low, high) > TURNS
        where = f"{recording.label}: q of joint {item.joint!r} runs from {low:.4g} to {high:.4g} {item.unit.si}"
        if beyond:
            hint = "Is it in degrees? Then add `unit` q=deg." if degrees else "Are unit, sign, offset and URDF right?"
            raise DatasetError(
                f"{where}, beyond its limits {lower:.4g} to {upper:.4g} in the URDF. {hint} `beyond_limits` accepts it."
            )
        if degrees and not stated and not np.isfinite(upper - lower):
            raise DatasetError(
                f"{where}, more than two turns. Give `unit` q=deg if it is in degrees, `unit` q=rad if not."
            )


def warn_of_implausible_forces(recording: RawRecording, plan: SignalPlan, robot: forcegp.robots.Robot | None) -> None:
    """Warn (DataWarning) of forces far beyond the limits of the URDF."""
    limits = {} if robot is None else {joint.name: joint.effort_limit for joint in robot.joints}
    for index, item in enumerate(plan.signals):
        limit = limits.get(item.joint, np.inf)
        most = float(max(-recording.lowest[index], recording.highest[index]))
        if item.signal == "u" and 0.0 < limit < np.inf and most > STRONGER * limit:
            warnings.warn(
                f"{recording.label}: u of joint {item.joint!r} reaches {most:.4g} {item.unit.si}; the URDF allows "
                f"{limit:.4g}. Is it in another unit (`unit` u=mNm), or on the motor's side of a gear (`scale`)?",
                DataWarning,
                stacklevel=2,
            )
