"""Estimated numbers as people read them: one table of values with intervals, and what the log leaves open."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import forcegp
from forcegp.cli.terminal import columns

SHOWN = {"m": ("mm", 1e3), "kg m^2": ("kg m²", 1.0)}
"""Units of files, and those that people read, with the factor between them."""
MOST_OPEN = 5
"""Combinations that the log does not tell apart, of which the first are named."""


def estimates_table(title: str, estimates: Mapping[str, forcegp.Estimate]) -> Any:
    """Start, value, 95 % interval and what decides it, below the law or body that has them."""
    rows, owner = [], None
    for name, each in estimates.items():
        unit, factor = SHOWN.get(each.unit, (each.unit, 1.0))
        low, high = (factor * end for end in each.interval)
        # decimals that show two digits of the interval, and four of the value where there is none
        size = factor * each.std if 0.0 < each.std < math.inf else 1e-3 * abs(factor * each.value)
        digits = max(0, 1 - math.floor(math.log10(size))) if size > 0.0 else 4
        show = (f"{{:.{digits}f}}" if digits < 10 else "{:.2g}").format
        of, part = owner_and_part(name)
        rows += [[of]] if of != owner else []
        owner = of
        numbers = show(factor * each.start), show(factor * each.value), f"{show(low)} … {show(high)}"
        rows.append([f"  {part}", *numbers, "" if unit == "1" else unit, each.decided_by])
    return columns(title, ["parameter", "start", "estimate", "95 % interval", "unit", "decided\nby the"], rows)


def owner_and_part(name: str) -> tuple[str, str]:
    """Law or body, and number: viscous and elbow, tool0 and center_of_mass.x."""
    for part in ("mass", "center_of_mass", "inertia"):
        owner, found, rest = name.partition(f".{part}")
        if found:
            return owner, f"{part}{rest}"
    owner, _, part = name.partition(".")
    return owner, part


def what_is_open(estimates: forcegp.posterior.Estimates) -> list[str]:
    """Sentences about what the prior decides, and what was changed."""
    lines = []
    if estimates.open_directions:
        shown, count = estimates.open_directions[:MOST_OPEN], len(estimates.open_directions)
        more = f"; and {count - len(shown)} more" if count > len(shown) else ""
        lines.append(
            f"Combinations that the prior decides, for no row tells their parts apart: {'; '.join(shown)}{more}."
        )
    if estimates.by_body:
        weak = ", ".join(f"{name} ({number} of 10)" for name, number in estimates.by_body.items())
        lines.append(f"Directions of single bodies that the prior decides: {weak}.")
    if estimates.base is not None:
        rank, condition = estimates.base.rank, estimates.base.condition
        lines.append(f"{rank} base parameters, condition number {condition:.3g}.")
    if estimates.thickened:
        lines.append(f"Links that were lines, plates or points got some thickness: {', '.join(estimates.thickened)}.")
    return lines
