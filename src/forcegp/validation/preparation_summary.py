"""How rows were filtered and differentiated, in words: no rig measures accelerations, so every score needs them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from forcegp.data import preparation_report


def preparation_lines(metadata: Mapping[str, Any]) -> list[str]:
    """`metadata["preparation"]` of a Dataset (`data.Preparation`) as sentences, the last step first."""
    report = preparation_report(metadata)
    if not report:
        return ["Preparation: none stated; q, v, u and a are scored as the dataset holds them."]
    lines = [f"Preparation: {_step(report)}"]
    removed = report.get("power_removed")
    if isinstance(removed, Mapping) and removed.get("a"):
        shares = ", ".join("–" if share is None else f"{100.0 * share:.3g} %" for share in removed["a"])
        lines.append(
            f"The filter took {shares} of the variance of the joints' acceleration; scores are against the rest."
        )
    for quantity, reason in dict(report.get("why") or {}).items():
        lines.append(f"Chosen automatically, {quantity}: {_reason(reason)}")
    earlier = report.get("earlier")
    return lines + (preparation_lines({"preparation": earlier}) if preparation_report({"preparation": earlier}) else [])


def _step(report: Mapping[str, Any]) -> str:
    parts = []
    delay = [float(value) for value in report.get("delay") or []]
    if any(delay):
        same = len(set(delay)) == 1
        delays = f"{1e3 * delay[0]:.3g}" if same else ", ".join(f"{1e3 * value:.3g}" for value in delay)
        parts.append(f"u taken from {delays} ms later")
    cutoff = report.get("cutoff")
    if cutoff is None:
        parts.append("no filter")
    else:
        source = report.get("differentiate")
        made = "v and a from it by central differences" if source == "q" else "a from v by central differences"
        what = "q and u" if source == "q" else "q, v and u"
        parts.append(
            f"zero-phase Butterworth low-pass of order {report.get('order')} at {cutoff:g} Hz on {what}, {made}"
        )
    if report.get("every", 1) > 1:
        every = report["every"]
        ending = "th" if every % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(every % 10, "th")
        parts.append(f"every {every}{ending} row")
    if report.get("trim"):
        parts.append(f"{report['trim']:g} s dropped at both ends of every episode")
    return "; ".join(parts) + "."


def _reason(reason: object) -> str:
    if isinstance(reason, Mapping):
        return "; ".join(f"{name} {value}" for name, value in reason.items())
    return str(reason)
