"""What a check found: how bad it is, what was seen, and what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np

Severity = Literal["ok", "look", "wrong"]
SEVERITIES: tuple[Severity, ...] = ("ok", "look", "wrong")
"""From harmless to spoiling every result."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One result of a check.

    severity: ok, nothing to do; look, a person should judge; wrong, results would be wrong.
    subject: what was checked, in a few words, the same for all logs.
    seen: what was seen, with joint, row, time and numbers.
    remedy: what to do about it; empty if nothing.
    joints: names of the joints concerned; numbers: the numbers of `seen`, for programs.
    """

    severity: Severity
    subject: str
    seen: str
    remedy: str = ""
    joints: tuple[str, ...] = ()
    numbers: Mapping[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        return {**vars(self), "joints": list(self.joints), "numbers": dict(self.numbers)}


wrong, look, ok = partial(Finding, severity="wrong"), partial(Finding, severity="look"), partial(Finding, severity="ok")


def worst(findings: Sequence[Finding]) -> Severity:
    """The severity of the worst of them; ok if there are none."""
    return SEVERITIES[max((SEVERITIES.index(finding.severity) for finding in findings), default=0)]


def plain(values: np.ndarray) -> list[float | None]:
    """Numbers for JSON, which has no NaN."""
    return [float(value) if np.isfinite(value) else None for value in values]


def listed(names: Sequence[str]) -> str:
    """`a, b and c`."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
