"""Findings about contacts that the rows contradict, from `forcegp.data.contact_doubts`."""

from __future__ import annotations

from forcegp.checks.check_input import CheckInput
from forcegp.checks.findings import Finding
from forcegp.data import contact_doubts
from forcegp.mechanics import MechanicalSystem


def contact_findings(inputs: CheckInput, system: MechanicalSystem | None) -> list[Finding]:
    """Contacts beside which the motion runs, whose force acts elsewhere or not at all, or that are missing."""
    return [
        Finding(
            severity="wrong" if doubt.kind == "off" else "look",
            subject="contact",
            seen=doubt.seen,
            remedy=doubt.remedy,
            numbers={"kind": doubt.kind, **doubt.numbers},
        )
        for doubt in contact_doubts(inputs.mended, system)
    ]
