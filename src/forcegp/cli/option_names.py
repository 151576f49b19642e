"""Names of arguments in messages, as the options of the command that printed them.

The library marks arguments in its messages by backquotes, as Python writes them: `points`, `mean='analytical'`. Options
have the same names, so the command line needs no message of its own.
"""

from __future__ import annotations

import re
from collections.abc import Collection

_ARGUMENT = re.compile(r"`([a-z_.]+)(?:=([^`]*))?`")

OTHERWISE = {
    "contacts": "contact",
    "folder": "out",
    "locked": "lock",
    "most_rows": "max_rows",
    "observe": "learn_from",
    "system": "robot",
}
"""Options whose argument has another name in Python."""

ELSEWHERE = {
    "`posterior.with_system(dataset.system)`": "--system data (of forcegp evaluate and rollout)",
    "forcegp.data.rows_in_contact": "--rows in-contact",
}
"""Calls of Python that an option stands for."""


def with_option_names(message: str, options: Collection[str]) -> str:
    """The message with --points for `points` and --points 5 for `points=5`, where the command has such an option.

    Arguments that the command does not have stay as they are.
    """

    def option(found: re.Match[str]) -> str:
        name, value = found[1], (found[2] or "").strip("'")
        name = name if name in options else OTHERWISE.get(name, name)
        if name not in options:
            return found[0]
        flag = f"--{name.replace('_', '-')}"
        return flag if value in ("", "True") else f"{flag}{'=' if value.startswith('-') else ' '}{value}"

    for call, words in ELSEWHERE.items():
        message = message.replace(call, words)
    return _ARGUMENT.sub(option, message)
