"""Median and range over seeds, and their format in Markdown tables."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def median_and_range(values: Iterable[float | None]) -> dict[str, Any] | None:
    """Median and range over seeds, with the values; None where there are none (or not for every seed)."""
    given = list(values)
    if not given or any(value is None for value in given):
        return None
    numbers = [float(value) for value in given if value is not None]
    return {"median": statistics.median(numbers), "min": min(numbers), "max": max(numbers), "values": numbers}


def medians(results: Sequence[Mapping[str, Any]], names: Iterable[str]) -> dict[str, Any]:
    """`median_and_range` of these entries over results; None for an entry that a result lacks."""
    return {name: median_and_range(each.get(name) for each in results) for name in names}


def in_columns(scores: Mapping[str, Mapping[str, Any] | None]) -> dict[str, float | None]:
    """`NAME_median`, `NAME_min` and `NAME_max` of every score, for a flat table."""
    return {
        f"{name}_{part}": None if score is None else score[part]
        for name, score in scores.items()
        for part in ("median", "min", "max")
    }


def formatted(value: Mapping[str, Any] | float | None, digits: int = 4) -> str:
    """`.0831 (.0825–.0847)` of a median with its range, `.0831` of a number, a dash of nothing."""
    if value is None:
        return "–"
    if isinstance(value, Mapping):
        if len(value["values"]) == 1:
            return number(value["median"], digits)
        return f"{number(value['median'], digits)} ({number(value['min'], digits)}–{number(value['max'], digits)})"
    return number(value, digits)


def number(value: float, digits: int = 4) -> str:
    """With that many decimals; where three or more are asked for, very small and very large ones as a power of ten."""
    if digits < 3 or value == 0 or 10.0**-digits * 5 <= abs(value) < 1e4:
        return f"{value:.{digits}f}"
    return f"{value:.1e}"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """First column left, the others right."""
    lines = [f"| {' | '.join(header)} |", f"|---|{'---:|' * (len(header) - 1)}"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])
