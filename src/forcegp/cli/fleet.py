"""`--logs-from LIST`: one command for many logs or robots, with a row of results for each; a run that ends is resumed.

A line of the list holds words of the command: a log, and what differs for it, such as its robot.
"""

from __future__ import annotations

import contextlib
import csv
import io
import shlex
import shutil
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from forcegp.atomic_files import write_text
from forcegp.cli.arguments import COMMANDS, command_class, parsed
from forcegp.cli.command import Command, options_of
from forcegp.cli.terminal import Terminal, facts
from forcegp.errors import FileFormatError, ForceGPError, InvalidInput
from forcegp.jobs import JOBS, Job, JobStore, run_jobs
from forcegp.parallel import Jobs

FLAG = "--logs-from"
OWN = ("--out", "--jobs")
"""Options that the whole run has; those of each log are its own."""
SWITCHES = ("--json", "--overwrite", "--debug")
TABLE = "fleet.csv"
SHORT = 80
"""Texts of results that a cell of the table takes."""
SHOWN = 12
"""Logs that failed which a terminal shows; the table has all."""


class Quiet(Terminal):
    """A terminal of a log among many, which keeps warnings and shows nothing."""

    def __init__(self) -> None:
        super().__init__(json=True)
        self.warnings: list[str] = []

    def note(self, text: str) -> None:
        """Nothing."""

    def warn(self, text: str) -> None:
        """Kept for the row."""
        self.warnings.append(" ".join(text.split()))

    def progress(self, what: str) -> Any:
        """Nothing."""
        return contextlib.nullcontext(lambda *_, **__: None)


@dataclass(frozen=True, kw_only=True)
class Fleet(Command):
    """A command, and the logs that it is run for."""

    interrupted = "rows of finished logs are kept, and the same command resumes"
    replaces = False

    command: str
    common: tuple[str, ...]
    logs_from: Path
    out: Path
    jobs: Jobs = 1

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Run it for each log. One that fails is a row that says so; what is finished, of the same files, stays.

        Raises InvalidInput for a folder of others, and BackendError where a process of this machine died.
        """
        if not self.out.parent.is_dir():
            raise InvalidInput(f"the folder {self.out.parent} does not exist; create it first.")
        lines, work = lines_of(self.command, self.common, self.logs_from, self.out), []
        kind = f"forcegp {self.command} {FLAG}"
        store = JobStore.open(self.out, kind, {"command": self.command}, overwrite=self.overwrite)
        for name, words in lines.items():
            # size and time of files, by which a row is known to be of them
            files = {word: Path(word).stat() for word in words if not word.startswith("-") and Path(word).is_file()}
            stamps = {word: [found.st_size, found.st_mtime_ns] for word, found in files.items()}
            spec = {"command": self.command, "words": words, "out": str(self.out / name), "files": stamps}
            work.append(Job(name, f"{__name__}:one", spec))
            if store.place(name).exists() and store.result(name)["error"]:
                shutil.rmtree(store.place(name))  # what was wrong may be mended
        with terminal.progress("running") as report:
            run_jobs(store, work, self.jobs, report)
        kept = {name: store.load(name) for name in lines}
        rows = [
            {"log": name, "folder": str(self.out / name), "cpu_seconds": row["cpu_seconds"]} | row["result"]
            for name, row in kept.items()
        ]
        write_text(self.out / TABLE, table_of(rows))
        failed = [row for row in rows if row["error"]]
        told = {row["log"]: row["error"] for row in failed[:SHOWN]}
        more = [f"and {len(failed) - SHOWN} more that failed"] if len(failed) > SHOWN else []
        done = f"{len(rows) - len(failed)} of {len(rows)} logs are done; numbers of each in {self.out / TABLE}"
        terminal.show(*([facts("failed", told)] if told else []), *more, done)
        return {"out": str(self.out), "table": str(self.out / TABLE), "rows": rows}


def fleet(words: Sequence[str], jobs: Jobs = 1) -> list[dict[str, Any]]:
    """The rows of `forcegp WORDS`, such as ["fit", "--logs-from", "list.txt", "--out", "fleet"].

    {"log", "folder", "error", "cpu_seconds", "warnings", "numbers"} each. `jobs` is a number of processes of this
    machine, or an `Executor` whose workers see the same files, such as Dask's `client.get_executor()`. Raises as the
    command.
    """
    asked = command_of(words)
    if not isinstance(asked, Fleet):
        raise InvalidInput(f"the words {shlex.join(words)!r} name no list of logs; add {FLAG} LIST.")
    return list(replace(asked, jobs=jobs).run(Quiet())["rows"])


def command_of(words: Sequence[str]) -> Command:
    """The command that words ask for, or the fleet of it. Raises as `parsed`."""
    asked = any(word.partition("=")[0] == FLAG for word in words) and not {"-h", "--help"} & set(words)
    if asked and words[0] in COMMANDS and "logs_from" in options_of(command_class(words[0])):
        return fleet_of(words[0], words[1:])
    return parsed(words)


def one(store: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The command for one log: its row. Whatever goes wrong with it is an error of that row."""
    terminal, found, error = Quiet(), {}, ""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: terminal.warn(str(message))
        warnings.simplefilter("default")
        try:
            asked = parsed([spec["command"], *spec["words"], "--out", spec["out"]])
            if asked.replaces:  # half of it may be there; what goes on where it was does so
                asked = replace(asked, overwrite=True)
            asked.check_paths()
            with asked.alone():
                found = numbers_of(asked.run(terminal))
        except (ForceGPError, OSError, MemoryError) as told:
            error = " ".join(str(told).split())
        except Exception as defect:  # one log must not cost the others theirs
            error = f"an error in forcegp itself, {type(defect).__name__}: {defect}"
    return {"error": error, "warnings": terminal.warnings, "numbers": found}


def numbers_of(content: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Numbers and short texts of what a command found, by their path; estimates by name and value. No settings."""
    found: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, Mapping):
            if "value" in value and "interval" in value:
                found[f"{prefix}{name}"] = value["value"]
            elif name != "settings":
                found |= numbers_of(value, f"{prefix}{name}.")
        elif isinstance(value, bool | int | float) or (isinstance(value, str) and len(value) < SHORT):
            found[f"{prefix}{name}"] = value
    return found


def table_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as CSV: log, folder, error and time, then every number that any of them has."""
    own = ["log", "folder", "error", "cpu_seconds"]
    numbers = list(dict.fromkeys(name for row in rows for name in row["numbers"] if name not in own))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*own, "warnings", *numbers])
    for row in rows:
        cells = [row["numbers"].get(name, "") for name in numbers]
        writer.writerow([*(row[name] for name in own), len(row["warnings"]), *cells])
    return text.getvalue()


def fleet_of(command: str, words: Sequence[str]) -> Fleet:
    """The run that the words of a command ask for with `FLAG`. Raises InvalidInput."""
    own, common = _split([word for word in words if word not in SWITCHES], (FLAG, *OWN))
    if not (own.get("--out") and own.get(FLAG)):
        raise InvalidInput(
            f"{FLAG} LIST needs --out FOLDER, which gets a folder for each log. See forcegp {command} --help."
        )
    jobs = own.get("--jobs", "1")
    if not jobs.isdigit() or jobs == "0":
        raise InvalidInput(f"--jobs is {jobs}; give the number of logs at once, at least 1.")
    switches = {word.removeprefix("--"): word in words for word in SWITCHES}
    return Fleet(
        command=command,
        common=tuple(common),
        logs_from=Path(own[FLAG]),
        out=Path(own["--out"]),
        jobs=int(jobs),
        **switches,
    )


def lines_of(command: str, common: Sequence[str], path: Path, out: Path) -> dict[str, list[str]]:
    """By name, the words of each line of a list. Raises InvalidInput for words of no command, and FileFormatError."""
    lines = dict[str, list[str]]()
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path} cannot be read ({error}); give a text file with a log in each line.") from None
    for number, line in enumerate(text.splitlines(), 1):
        try:
            given = shlex.split(line, comments=True)
            if not given:
                continue
            differing = [word.partition("=")[0] for word in given if word.startswith("--")]
            words = [*_split(common, differing)[1], *given]
            asked: Any = parsed([command, *words, "--out", str(out)])
            name = (asked.logs[0] if hasattr(asked, "logs") else asked.log).name.partition(".")[0]
            while not name or name in lines or name == JOBS:  # the last is where rows are kept
                name += f"-{number}"
            lines[name] = words
        except (InvalidInput, ValueError) as error:
            raise InvalidInput(f"line {number} of {path}: {error}") from None
    if not lines:
        raise InvalidInput(f"{path} names no log; write one in each line, with the options that differ for it.")
    return lines


def _split(words: Sequence[str], flags: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Values of these options, written with a blank or "=", and the words that are left."""
    found, left, open_ = dict[str, str](), list[str](), ""
    for word in words:
        flag, equals, value = word.partition("=")
        if open_:
            found[open_], open_ = word, ""
        elif flag not in flags:
            left.append(word)
        else:
            found[flag], open_ = value, "" if equals else flag
    return found, left
