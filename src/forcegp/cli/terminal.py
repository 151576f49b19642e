"""Output of a command: results and tables on stdout, everything else on stderr; with --json, only JSON on stdout."""

from __future__ import annotations

import ctypes
import json
import os
import re
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any

from forcegp.errors import printable
from forcegp.progress import Listener, watched

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.table import Table

    from forcegp.doubts import Doubts

_ARGUMENT = re.compile(r"`([a-z_.]+)(?:=([^`]*))?`")

OTHERWISE = {"contacts": "contact", "folder": "out", "locked": "lock", "model": "robot"}
"""Options whose argument has another name in Python."""
PLAIN_SECONDS = 10.0  # between two lines about progress where there is no terminal to draw a bar on
UNLIMITED = 10_000  # columns of a terminal that cuts nothing
NONE = "–"
COLORS = {"wrong": "bold red", "look": "yellow", "ok": "green"}  # of doubts by their level
PLAIN: dict[str, Any] = {"title_justify": "left", "title_style": "bold", "pad_edge": False}


def with_option_names(message: str, options: Collection[str]) -> str:
    """The message with --points 5 for `points=5`, where the command has such an option; those of others stay."""

    def option(found: re.Match[str]) -> str:
        name, value = found[1], (found[2] or "").strip("'")
        name = name if name in options else OTHERWISE.get(name, name)
        if name not in options:
            return found[0]
        flag = f"--{name.replace('_', '-')}"
        return flag if value in ("", "True") else f"{flag}{'=' if value.startswith('-') else ' '}{value}"

    return _ARGUMENT.sub(option, message)


def _console(**how: Any) -> Console:
    from rich.console import Console
    from rich.segment import Segment

    class Plain(Console):
        """Shows names as they are, whatever they mean to a terminal."""

        def render(self, *given: Any, **more: Any) -> Any:
            for segment in super().render(*given, **more):
                shown = segment.control or printable(segment.text) == segment.text
                yield segment if shown else Segment(printable(segment.text), segment.style)

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # rich would end with the code of an error

    return Plain(highlight=False, markup=False, emoji=False, **how)


class Terminal:
    """A context in which a command runs.

    With `json`, the process's stdout is pointed at stderr until the result is printed, so that nothing a library prints
    (not even from C) can stand before or after the one JSON object; it is put back at the end of the context.
    `options` are the command's, by which notes and warnings of the library name arguments.
    """

    def __init__(self, *, json: bool, options: Collection[str] = ()) -> None:
        self.json = json
        self.options = options
        self.names_stages = False
        """Report the beginning of every stage where there is no terminal to draw a bar on."""
        self._stdout: int | None = None

    # rich is imported when something is shown, so that --help and errors come at once

    @cached_property
    def out(self) -> Console:
        """What the command found."""
        return _console(soft_wrap=False)

    @cached_property
    def err(self) -> Console:
        """What happens meanwhile."""
        return _console(stderr=True, soft_wrap=True)

    def __enter__(self) -> Terminal:
        if self.json:
            sys.stdout.flush()
            self._stdout = os.dup(1)
            os.dup2(2, 1)
        return self

    def __exit__(self, *_: object) -> None:
        if self._stdout is not None:
            try:
                sys.stdout.flush()
                ctypes.CDLL(None).fflush(None)  # what C has kept until now belongs on stderr, too
            finally:
                os.dup2(self._stdout, 1)
                os.close(self._stdout)
                self._stdout = None

    def result(self, value: Mapping[str, Any]) -> None:
        """Print the result of the command as one JSON object, if that was asked for."""
        if self._stdout is not None:
            sys.stdout.flush()
            value = json.loads(json.dumps(value), parse_constant=lambda _: None)  # JSON has no NaN and infinity
            with os.fdopen(os.dup(self._stdout), "w", encoding="utf-8") as stdout:
                stdout.write(json.dumps(value, indent=1) + "\n")

    def show(self, *renderables: RenderableType) -> None:
        """Print the result, texts as they are; nothing with --json. A table gets the columns that it needs."""
        if not self.json:
            from rich.measure import Measurement
            from rich.text import Text

            for renderable in (Text(each) if isinstance(each, str) else each for each in renderables):
                # cells that must not be folded: a number without its end is a wrong number
                wide = self.out.options.update(width=UNLIMITED)
                needed = 0 if isinstance(renderable, Text) else Measurement.get(self.out, wide, renderable).minimum
                (self.out if needed <= self.out.width else _console(width=needed)).print(renderable)

    def command(self, words: str) -> None:
        """A command to copy, in one line whatever the width."""
        if not self.json:
            self.out.print(words, style="bold", soft_wrap=True)

    def note(self, text: str) -> None:
        """Report on stderr what was done."""
        self.err.print(self.worded(text), style="dim")

    def warn(self, text: str) -> None:
        """Print a warning on stderr."""
        self.err.print(f"warning: {' '.join(self.worded(text).split())}", style="yellow")

    def worded(self, text: str) -> str:
        """A sentence of the library in terms of this command's options."""
        return with_option_names(text, self.options)

    @contextmanager
    def progress(self, what: str) -> Iterator[None]:
        """A bar with the remaining time on a terminal, a line now and then elsewhere. Before work tells: a spinner."""
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        if not self.err.is_terminal:
            with watched(self._lines(what)):
                yield
            return
        of_a_task = TextColumn("{task.description}", markup=False), BarColumn(bar_width=30), TimeElapsedColumn()
        left = TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[note]}", markup=False)
        with Progress(SpinnerColumn(), *of_a_task, *left, console=self.err, transient=True) as bars:
            task = bars.add_task(what, total=None, note="")

            def report(done: int, total: int, note: str) -> None:
                bars.update(task, completed=done, total=total, note=note)

            with watched(report):
                yield

    def _lines(self, what: str) -> Listener:  # at most one every few seconds
        reported = time.monotonic()
        if self.names_stages:
            self.note(f"{what} ...")

        def report(done: int, total: int, note: str) -> None:
            nonlocal reported
            if time.monotonic() - reported >= PLAIN_SECONDS and done < total:
                reported = time.monotonic()
                self.note(f"{what}: {done / total:.0%}{note and f', {note}'}")

        return report


def facts(title: str, values: Mapping[str, str]) -> Table:
    """Names and values, one per line."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, box=None, show_header=False, **PLAIN)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in values.items():
        table.add_row(name, Text(value))
    return table


def columns(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], *, long_names: bool = False) -> Table:
    """A table of text and numbers; texts of the first column are folded if `long_names`."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, box=box.SIMPLE_HEAD, collapse_padding=True, **PLAIN)
    for place, name in enumerate(header):
        folded = long_names and not place
        # rich counts the longest word, where a cell must not be folded at all
        cells = [cell for row in (header, *rows) for cell in row[place : place + 1]]
        widest = max(len(line) for cell in cells for line in cell.split("\n"))
        how: Any = {} if folded else {"no_wrap": True, "min_width": widest}
        table.add_column(Text(name), justify="right" if place else "left", overflow="fold", **how)
    for row in rows:
        table.add_row(*map(Text, row))  # as a str, "[Nm]" would be a style
    return table


def doubts_table(doubts: Doubts, worded: Callable[[str], str]) -> Table:
    """One paragraph per doubt: how bad it is, what was seen, and below it what to do, `worded` for the command."""
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 1))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for doubt in doubts:
        text = Text(f"{doubt.about}: ", style="bold").append(worded(doubt.what), style="not bold")
        table.add_row(Text(doubt.level, style=COLORS[doubt.level]), text)
        if doubt.advice:
            table.add_row("", Text(f"→ {worded(doubt.advice)}", style="dim"))
    return table


def shown(value: float | None, pattern: str = "{:.3g}", factor: float = 1.0) -> str:
    """The number times a factor in this pattern, a dash for none."""
    return NONE if value is None else pattern.format(factor * value)
