"""Help pages: what a command does, examples, and its options in groups, within the width of the terminal."""

from __future__ import annotations

import ast
import inspect
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from tyro.conf import Positional

from forcegp.cli.command import Command

GROUPS: Mapping[str, str] = {
    "Input": "baseline task free free_seconds mapping episodes headerless delimiter side_by_side",
    "Columns": "time q v u a step joints orientation axes ned unit sign episode unwrap",
    "Timing": "start end gap rate",
    "Preparation": "cutoff differentiate delay lag stance every trim",
    "Robot": "robot shapes inertias base root identified "
    "lock armature gravity beyond_limits link system contact feet wheels",
    "Scene": "surface contact_model tool_friction friction_coefficient joint_friction patch wind",
    "Motion": "seconds trajectories starts integrator posture limits limit_share avoid "
    "clearance tries bandwidth false_alarms",
    "Noise": "noise force_noise measured_torque",
    "Model": "forces evidence identification",
    "Fit": "points learning_points rows engine restarts iterations hyperprior checks correct accept",
    "Score": "split guard seeds seed_list horizon strict",
    "Program": "to steps covariance jacobian unchecked",
    "Compute": "preset seed jobs device port",
    "Output": "out plots report html write_mapping docs overwrite json",
    "Other": "debug",
}
"""Options of all commands by purpose, in the order of the pages: a name means the same everywhere."""

WIDEST = 100
"""Columns of a page at most."""
COLUMN = 22
"""Where the texts of options begin, if there is room for them."""
HELP = ("-h, --help", "Show this page.")


def front_page(description: str, summaries: Mapping[str, str]) -> str:
    """The page of `forcegp --help`."""
    others = [HELP, ("--version", "Print the version.")]
    rows = [*_section("Commands", summaries.items()), *_section("Other", others)]
    return "\n".join(["usage: forcegp COMMAND [OPTIONS]", "", *_paragraphs(description), *rows])


def command_page(name: str, kind: type[Command]) -> str:
    """The page of `forcegp NAME --help`."""
    options = list(_options(kind))
    arguments = [each for each in options if not each.head.startswith("-")]
    required = [each.head for each in options if each not in arguments and each.required]
    usage = " ".join(["usage: forcegp", name, *(each.head for each in arguments), *required, "[OPTIONS]"])
    rows = _section("Arguments", [(each.head, each.text) for each in arguments])
    by_name = {each.name: (each.head, f"{each.text} {each.hint}") for each in options}
    for title, names in GROUPS.items():
        shown = [by_name[each] for each in names.split() if each in by_name]
        rows += _section(title, [*shown, HELP] if title == "Other" else shown)
    text = inspect.cleandoc(kind.__doc__ or "").replace("For example:", "Examples:")
    return "\n".join([*_wrap(usage, _width()), "", *_paragraphs(text), *rows])


def show(page: str) -> None:
    """Print a page, with bold headings on a terminal, and `?` for letters that stdout does not take."""
    if sys.stdout.isatty() and "NO_COLOR" not in os.environ and os.environ.get("TERM") != "dumb":
        page = re.sub(r"(?m)^\w+:$", "\x1b[1m\\g<0>\x1b[0m", page)
    encoding = sys.stdout.encoding or "utf-8"
    print(page.encode(encoding, "replace").decode(encoding))


def _width() -> int:
    return max(40, min(WIDEST, shutil.get_terminal_size().columns))


def _section(title: str, rows: Collection[tuple[str, str]]) -> list[str]:
    """A heading, and names and texts in two columns; texts that do not fit beside their names begin below them."""
    width = _width()
    column = COLUMN if width >= 60 else 6
    shown = ["", f"{title}:"] if rows else []
    for name, text in rows:
        lines = _wrap(" ".join(text.split()), width - column) or [""]
        beside = len(name) + 4 <= column
        shown.append(f"  {name}".ljust(column) + lines[0] if beside else f"  {name}")
        shown += (" " * column + line for line in (lines[1:] if beside else lines))
    return shown


def _paragraphs(text: str) -> Iterator[str]:
    """The lines of a text: sentences broken between words, commands so that they can be pasted."""
    for paragraph in re.split(r"\n(?=\n| )|(?<=:)\n", text):
        if not paragraph.startswith(" "):
            yield from [""] * paragraph.startswith("\n")
            yield from _wrap(" ".join(paragraph.split()), _width())
        elif len(paragraph) <= _width():
            yield paragraph
        else:
            whole = re.sub(r"(?<= )(--[\w-]+) (?=[^-])", "\\1\xa0", paragraph)  # an option stays with its value
            lines = _wrap(whole, _width() - 2, indent="      ")
            yield from " \\\n".join(lines).replace("\xa0", " ").split("\n")


def _wrap(text: str, width: int, indent: str = "") -> list[str]:
    return textwrap.wrap(text, width, break_on_hyphens=False, break_long_words=False, subsequent_indent=indent)


@dataclass(frozen=True)
class Option:
    """One field of a command: what stands on the command line, what it means, and what it is unless it is given."""

    name: str
    head: str
    text: str
    hint: str
    required: bool


def _options(kind: type[Command]) -> Iterator[Option]:
    texts, hints = _texts(kind), get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        marks = getattr(hints[field.name], "__metadata__", ())
        metavar = _first(marks, "metavar") or "|".join(_choices(hints[field.name]))
        flag = flag_of(field, hints[field.name])
        head = metavar if flag is None else f"{flag} {metavar}".strip()
        hint = _first(marks, "help_behavior_hint") or _default(field.default)
        yield Option(field.name, head, texts[field.name], hint, field.default is MISSING)


def flag_of(field: Field[Any], hint: Any) -> str | None:
    """--points, or --no-checks for a switch that is on; None for what has no name on the command line."""
    if get_args(Positional[int])[1] in get_args(hint):
        return None
    return f"--{'no-' if field.default is True else ''}{field.name.replace('_', '-')}"


def _first(marks: Iterable[Any], name: str) -> str:
    """What the first of these annotations states about it, or nothing."""
    return next((stated for mark in marks if (stated := getattr(mark, name, None))), "")


def _choices(type_: Any) -> list[str]:
    """The words of a Literal, also of an optional or annotated one."""
    if get_origin(type_) is Literal:
        return [str(word) for word in get_args(type_)]
    return [word for part in get_args(type_) for word in _choices(part)]


def _default(value: Any) -> str:
    """The default of an option that states none: nothing for switches, and where None or () say nothing."""
    if value is MISSING:
        return "(required)"
    if isinstance(value, bool) or value in (None, ()):
        return ""
    entries = value if isinstance(value, tuple) else (value,)
    return f"(default: {','.join(f'{each:g}' if isinstance(each, float) else str(each) for each in entries)})"


def _texts(kind: type[Command]) -> dict[str, str]:
    """What the source states below each field, also those that are inherited."""
    texts: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        if issubclass(each, Command):
            module = ast.parse(Path(inspect.getfile(each)).read_text(encoding="utf-8"))
            (source,) = (it for it in module.body if isinstance(it, ast.ClassDef) and it.name == each.__name__)
            for pair in pairwise(source.body):
                match pair:
                    case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(words))):
                        texts[name] = words
    return texts
