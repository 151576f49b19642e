"""Pages of Markdown from Jinja templates, which lie beside the modules that have their numbers."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from forcegp.evaluation.metrics import formatted, markdown_table, number


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
