"""What a quick check found, in one line, for the commands that learn from a log."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import forcegp.checks

MOST = 3
"""Findings whose text is shown; the others by their subject."""


def findings_in_one_line(
    findings: Sequence[forcegp.checks.Finding], data: Path, words: Sequence[str] = (), advise: bool = False
) -> str | None:
    """The worst findings, the subjects of the others, and where to read more; None if there are none.

    `words` are the options of forcegp check that show the same findings; `advise` names what to do about the worst
    finding instead, where no options do.
    """
    if not findings:
        return None
    shown = [f"{each.subject}: {each.seen.rstrip('.')}" for each in findings[:MOST]]
    more = dict.fromkeys(each.subject for each in findings[MOST:])
    others = [f"further {', '.join(more)}"] if more else []
    see = f"See {shlex.join(['forcegp', 'check', str(data), *words])}"
    following = findings[0].remedy.rstrip(".") if advise else see
    return f"{'; '.join([*shown, *others])}. {following} (--no-checks does not look)"
