"""Columns found by the names of the joints, only where nothing else could be meant."""

from __future__ import annotations

import re
from collections.abc import Sequence

from forcegp.errors import InvalidInput
from forcegp.recordings.source import Source

WORDS = {
    "q": {"q", "pos", "position", "positions", "angle", "angles", "joint_pos", "joint_position"},
    "v": {"v", "qd", "dq", "vel", "velocity", "velocities", "joint_vel", "joint_velocity"},
    "u": {"u", "tau", "torque", "torques", "effort", "efforts", "joint_torque", "joint_effort"},
    "a": {"a", "qdd", "ddq", "acc", "acceleration", "accelerations"},
    "time": {"t", "time", "timestamp", "stamp", "time_s", "seconds"},
}
"""What the rest of a column's name, beside that of the joint, must mean."""


def guessed_columns(signal: str, joints: Sequence[str], source: Source) -> tuple[str, ...] | None:
    """One column per joint whose names are the joint's name in a text that means `signal`; None if there is none.

    Raises InvalidInput if several sets of columns could be meant.
    """
    templates: dict[tuple[str, str], dict[str, str]] = {}
    for column in source.columns():
        for joint in joints:
            for found in re.finditer(rf"(?<![A-Za-z0-9]){re.escape(joint)}(?![A-Za-z0-9])", column):
                around = column[: found.start()], column[found.end() :]
                templates.setdefault(around, {})[joint] = column
    fitting = [
        tuple(found[joint] for joint in joints)
        for around, found in templates.items()
        if len(found) == len(joints) and _says(signal, around)
    ]
    if len(fitting) > 1:
        candidates = " or ".join(", ".join(columns) for columns in fitting)
        raise InvalidInput(f"{source.path}: {signal} could be {candidates}; choose with --{signal}.")
    return fitting[0] if fitting else None


def guessed_time(source: Source, used: Sequence[str]) -> str | None:
    """The column that must be the time: by the format, or the only one of such a name. None if there is none."""
    by_format = source.time_beside(used)
    if by_format is not None:
        return by_format
    named = [column for column in source.columns() if column.lower() in WORDS["time"]]
    if len(named) > 1:
        raise InvalidInput(f"{source.path}: the time could be {' or '.join(named)}; choose with `time`.")
    return named[0] if named else None


def _says(signal: str, around: tuple[str, str]) -> bool:
    """Do the last word before the joint's name or the first after it name the signal?"""
    before = re.split(r"[^A-Za-z_]+", around[0].rstrip("_.:/ -["))[-1]
    after = re.split(r"[^A-Za-z_]+", around[1].lstrip("_.:/ -]"))[0]
    words = {word.strip("_").lower() for word in (before, after)} - {""}
    return bool(words & WORDS[signal])
