"""Lists of column names in short, `pos{1..7}` or `{left,right}_arm`, and columns found by the names of the joints."""

from __future__ import annotations

import re
from collections.abc import Sequence

from forcegp.errors import InvalidInput
from forcegp.recordings.source import Source

BRACES = re.compile(r"\{([^{}]*)\}")
RANGE = re.compile(r"(\d+)\.\.(\d+)")
LONGEST_LIST = 4096
JOINTS = "joints"


def expanded(pattern: str, joints: Sequence[str]) -> list[str]:
    """Every text that a pattern stands for, in order; the braces furthest left change slowest.

    `{1..7}` counts (`{01..12}` with leading zeros, `{7..1}` downwards), `{a,b}` lists, `{joints}` is every joint name.
    Raises InvalidInput for other braces, and for lists longer than 4096.
    """
    found = BRACES.search(pattern)
    if found is None:
        if "{" in pattern or "}" in pattern:
            raise InvalidInput(f"{pattern!r} has a brace without its partner; write for example pos{{1..7}}.")
        return [pattern]
    before, after = pattern[: found.start()], pattern[found.end() :]
    rests = expanded(after, joints)
    texts = [before + choice + rest for choice in _choices(pattern, found[1], joints) for rest in rests]
    if len(texts) > LONGEST_LIST:
        raise InvalidInput(f"{pattern!r} stands for more than {LONGEST_LIST} columns.")
    return texts


def listed(text: str) -> list[str]:
    """The parts of a text between commas; commas in braces, backticks and brackets do not count."""
    parts, depth, quoted, start = [], 0, False, 0
    for position, letter in enumerate(text):
        if letter == "`":
            quoted = not quoted
        elif not quoted and letter in "{[(":
            depth += 1
        elif not quoted and letter in "}])":
            depth -= 1
        elif letter == "," and depth == 0 and not quoted:
            parts.append(text[start:position].strip())
            start = position + 1
    parts.append(text[start:].strip())
    if "" in parts:
        raise InvalidInput(f"{text!r} has an empty place in its list; write for example: pos1,pos2")
    return parts


def _choices(pattern: str, inside: str, joints: Sequence[str]) -> list[str]:
    counted = RANGE.fullmatch(inside)
    if counted:
        first, last = int(counted[1]), int(counted[2])
        if abs(last - first) >= LONGEST_LIST:
            raise InvalidInput(f"{pattern!r} stands for more than {LONGEST_LIST} columns.")
        padded = len(counted[1]) if counted[1].startswith("0") and len(counted[1]) > 1 else 0
        step = 1 if last >= first else -1
        return [f"{number:0{padded}d}" for number in range(first, last + step, step)]
    if inside == JOINTS:
        if not joints:
            raise InvalidInput(f"{pattern!r} asks for the names of the joints, which are not known; add `joints`.")
        return list(joints)
    choices = [choice.strip() for choice in inside.split(",")]
    if len(choices) > 1 and all(choices):
        return choices
    raise InvalidInput(f"{pattern!r}: write {{1..7}}, {{a,b}} or {{joints}} in braces, not {{{inside}}}.")


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
