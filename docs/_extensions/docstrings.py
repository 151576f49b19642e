"""Docstrings of this project as reStructuredText: they are plain text with `names`, "name: meaning" lists and formulas.

Autodoc reads reStructuredText, where |x|, *args and a wrapped "name: meaning" would be markup or an error.
"""

import re
from itertools import zip_longest
from typing import Any

from sphinx.application import Sphinx

NAME = r"[\w*<>.\[\]`/()-]+"
MEANING = re.compile(rf"(?P<names>{NAME}(?:(?:,| and| or)? {NAME}){{0,5}}): (?P<text>\S.*)")
UNDERLINE = re.compile(r"-{3,}")


def as_rst(lines: list[str]) -> list[str]:
    """The same text in reStructuredText."""
    text = with_one_markup("\n".join(lines))
    lines = re.sub(r"`[^`]*`", lambda name: " ".join(name[0].split()), text).splitlines()  # a name ends on its line
    found: list[str] = []
    inside = ""  # "list" or "code": what an indented line goes on with
    for line, following in zip_longest(lines, lines[1:], fillvalue=""):
        text = line.strip()
        meaning = MEANING.fullmatch(text)
        if not text:
            found.append("")
            inside = "code" if inside == "code" else ""
        elif UNDERLINE.fullmatch(text):
            continue
        elif UNDERLINE.fullmatch(following.strip()):
            found += ["", f".. rubric:: {text}", ""]
            inside = "list"
        elif line[0] == " " and inside == "list":
            found.append("  " + escaped(text))
        elif line[0] == " ":
            found += [] if inside == "code" else ["", ".. code-block:: text", ""]
            found.append("   " + line)
            inside = "code"
        elif text.startswith("* "):
            found += ["", "* " + escaped(text[2:])]
            inside = "list"
        elif meaning is not None and is_item(meaning["names"], following, inside, found):
            found += ["", f"* **{escaped(meaning['names'].replace('`', ''))}**: {escaped(meaning['text'])}"]
            inside = "list"
        else:
            found += ["", escaped(text)] if inside else [escaped(text)]
            inside = ""
    return [*found, ""]


def is_item(names: str, following: str, inside: str, found: list[str]) -> bool:
    """Whether "names: meaning" is an item of a list and no sentence with a colon."""
    if following.startswith(" ") or inside == "list":
        return True
    return bool(found) and not found[-1] and re.fullmatch(r"[a-z_][\w*<>.]*(, [\w*<>.]+)*", names) is not None


def with_one_markup(text: str) -> str:
    """Names in single backquotes, without roles."""
    return re.sub(r"(?::\w+:)?`~?([^`]+)`", r"`\1`", text.replace("``", "`"))


def escaped(text: str) -> str:
    """Names in backquotes as links or code; everything else as it stands."""
    parts = re.split(r"(`[^`]+`)", text)
    return "".join(marked(part) if part[:1] == "`" else re.sub(r"([*|_\\`])", r"\\\1", part) for part in parts)


def marked(name: str) -> str:
    """A link for what looks like a class or a full name, code otherwise."""
    bare = name.strip("`")
    return name if re.fullmatch(r"(forcegp\.)?([a-z_]+\.)*[A-Z]\w+", bare) else f"``{bare}``\\ "


def convert(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Replace the lines of a docstring in place, as autodoc asks."""
    lines[:] = as_rst(lines)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("autodoc-process-docstring", convert)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
