"""What a quick check found, in one line, for the commands that learn from a log."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import forcegp.checks

MOST = 3
"""Findings whose text is shown; the others by their subject."""


def findings_in_one_line(findings: Sequence[forcegp.checks.Finding], data: Path) -> str | None:
    """The worst findings, the subjects of the others, and where to read more; None if there are none."""
    if not findings:
        return None
    shown = [f"{each.subject}: {each.seen.rstrip('.')}" for each in findings[:MOST]]
    more = dict.fromkeys(each.subject for each in findings[MOST:])
    others = [f"further {', '.join(more)}"] if more else []
    return f"{'; '.join([*shown, *others])}. See forcegp check {data} (--no-checks does not look)"
