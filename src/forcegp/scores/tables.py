"""Numbers as text: medians over runs, Markdown tables, and pages from Jinja templates."""

import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any


def median_and_range(values: Iterable[float | None]) -> dict[str, Any] | None:
    """Median and range over seeds, with the values; None where there are none (or not for every seed)."""
    given = list(values)
    if not given or any(value is None for value in given):
        return None
    numbers = [float(value) for value in given if value is not None]
    return {"median": statistics.median(numbers), "min": min(numbers), "max": max(numbers), "values": numbers}


def formatted(value: Mapping[str, Any] | float | None, digits: int = 4) -> str:
    """`.0831 (.0825–.0847)` of a median with its range, `.0831` where that is one number, a dash of nothing."""
    if not isinstance(value, Mapping):
        return number(value, digits)
    middle, low, high = (number(value[name], digits) for name in ("median", "min", "max"))
    return middle if low == high else f"{middle} ({low}–{high})"


def number(value: float | None, digits: int = 4) -> str:
    """With that many decimals; where three or more are asked for, very small and very large ones as a power of ten."""
    if value is None:
        return "–"
    if digits < 3 or value == 0 or 10.0**-digits * 5 <= abs(value) < 1e4:
        return f"{value:.{digits}f}"
    return f"{value:.1e}"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """First column left, the others right."""
    lines = [f"| {' | '.join(header)} |", f"|---|{'---:|' * (len(header) - 1)}"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def alike(texts: Iterable[tuple[str, Any]]) -> list[list[tuple[str, Any]]]:
    """Texts and what they are about, in groups whose texts differ in numbers alone."""
    groups: dict[str, list[tuple[str, Any]]] = {}
    for text, about in texts:
        groups.setdefault(re.sub(r"\d[\d.e+-]*", "#", text), []).append((text, about))
    return list(groups.values())


def rendered(template: Path, **values: Any) -> str:
    """The text of a template; one blank line between paragraphs.

    Templates have the filters `formatted`, `number` and `table` (header and rows) beside Jinja's own. What a template
    asks for and is not given raises jinja2.UndefinedError.
    """
    from jinja2 import Environment, StrictUndefined

    pages = Environment(undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    pages.filters |= {"formatted": formatted, "number": number, "table": lambda rows, head: markdown_table(head, rows)}
    text = pages.from_string(template.read_text(encoding="utf-8"))
    return re.sub(r"\n{3,}", "\n\n", text.render(values)).strip() + "\n"
