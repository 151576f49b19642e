"""Short ways to write lists of column names: `pos{1..7}`, `{left,right}_arm`, `position.{joints}`."""

from __future__ import annotations

import re
from collections.abc import Sequence

from forcegp.errors import InvalidInput

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
