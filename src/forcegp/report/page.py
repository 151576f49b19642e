"""One self-contained HTML page: what was found, the robot in motion, pictures, tables, and how it was made."""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from forcegp import __version__
from forcegp.atomic_files import atomic_file
from forcegp.scores.figures.style import Picture


@dataclass(frozen=True)
class Table:
    """Rows of text under a header."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, eq=False)
class Page:
    """What a page shows, from top to bottom. What is empty is left out."""

    title: str
    best: str
    """The one sentence to remember."""
    findings: Sequence[tuple[str, str]] = ()
    """Subjects, and what was found."""
    scene: str = ""
    """An HTML document with the robot (`scene.recording`)."""
    scene_notes: Sequence[str] = ()
    """What the arrows are; or why there is no robot."""
    pictures: Sequence[Picture] = ()
    tables: Sequence[Table] = ()
    next_steps: Sequence[tuple[str, str]] = ()
    """What to do next, and the command for it."""
    details: Mapping[str, Any] = field(default_factory=dict)
    """The resolved configuration, for those who want to repeat it."""


MARK = "Written by forcegp"


def is_page(path: Path) -> bool:
    """Whether the file was written by `write_page`."""
    return MARK in path.read_text(encoding="utf-8", errors="replace")


def write_page(path: str | Path, page: Page, *, overwrite: bool = True) -> None:
    """Write the page to a temporary name and rename it.

    Raises InvalidInput if the folder does not exist, or the file does and may not be replaced.
    """
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["base64"] = lambda png: base64.b64encode(png).decode()
    template = environment.from_string(files("forcegp.report").joinpath("page.html").read_text(encoding="utf-8"))
    details = json.dumps(page.details, indent=1, default=str) if page.details else ""
    with atomic_file(path, overwrite=overwrite) as temporary:
        temporary.write_text(
            template.render(page=page, details=details, version=__version__, mark=MARK) + "\n", encoding="utf-8"
        )
