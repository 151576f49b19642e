"""`Finding`: what rows of a log show of it, of its contacts or of its robot, and what to do about it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

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
    correction: what an import has to state about the columns, for `ColumnMapping.corrected_by`: unit, sign and order by
    signal, for all joints or one each, in the order of the joints; orientation of q and axes of v and a.
    """

    severity: Severity
    subject: str
    seen: str
    remedy: str = ""
    joints: tuple[str, ...] = ()
    numbers: Mapping[str, Any] = field(default_factory=dict)
    correction: Mapping[str, Mapping[str, tuple[Any, ...]]] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.seen} {self.remedy}".strip()

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        correction = {what: {name: list(x) for name, x in each.items()} for what, each in self.correction.items()}
        return {**vars(self), "joints": list(self.joints), "numbers": dict(self.numbers), "correction": correction}


wrong, look, ok = partial(Finding, severity="wrong"), partial(Finding, severity="look"), partial(Finding, severity="ok")


def import_flags(correction: Mapping[str, Mapping[str, tuple[Any, ...]]]) -> str:
    """The options of `forcegp import` that state these units and signs, orders of quaternions and axes."""
    texts = [f"--{what} {own[0]}" for what in ("orientation",) for own in correction.get(what, {}).values()]
    for what in ("axes", "unit", "sign"):
        stated = correction.get(what, {})
        each = (
            f"{name}={','.join(x if isinstance(x, str) else f'{x:g}' for x in own)}" for name, own in stated.items()
        )
        texts += [f"--{what} {','.join(each)}"] if stated else []
    return " ".join(texts)


def worst(findings: Sequence[Finding]) -> Severity:
    """The severity of the worst of them; ok if there are none."""
    return SEVERITIES[max((SEVERITIES.index(finding.severity) for finding in findings), default=0)]


def listed(names: Sequence[str]) -> str:
    """`a, b and c`."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
