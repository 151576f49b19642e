"""`--logs-from LIST`: one command for many logs, each a line of words that differ, with a row of results for each."""

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

from forcegp.atomic_files import unreadable, write_text
from forcegp.cli.arguments import COMMANDS, command_class, parsed
from forcegp.cli.command import Command, options_of
from forcegp.cli.terminal import Terminal, facts
from forcegp.errors import FileFormatError, ForceGPError, InvalidInput, printable, spreadsheet_cell
from forcegp.jobs import JOBS, Job, JobStore, run_jobs
from forcegp.parallel import Jobs

FLAG = "--logs-from"
SWITCHES = ("--json", "--overwrite", "--debug")
TABLE = "fleet.csv"
SHORT = 80  # texts of results that a cell of the table takes


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
        return contextlib.nullcontext()


@dataclass(frozen=True, kw_only=True)
class Fleet(Command):
    """A command, and the logs that it is run for."""

    interrupted, replaces = "rows of finished logs are kept, and the same command resumes", False

    command: str
    common: tuple[str, ...]
    logs_from: Path
    out: Path
    jobs: Jobs = 1

    def run(self, terminal: Terminal) -> Mapping[str, Any]:
        """Run it for each log. One that fails is a row that says so; what is finished, of the same files, stays."""
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
        with terminal.progress("running"):
            run_jobs(store, work, self.jobs)
        kept = {name: store.load(name) for name in lines}
        rows = [{"log": name, "folder": str(self.out / name), "cpu_seconds": each["cpu_seconds"], **each["result"]}
                for name, each in kept.items()]  # fmt: skip
        write_text(self.out / TABLE, table_of(rows))
        failed = {row["log"]: row["error"] for row in rows if row["error"]}
        done = f"{len(rows) - len(failed)} of {len(rows)} logs are done; numbers of each in {self.out / TABLE}"
        terminal.show(*([facts("failed", failed)] if failed else []), done)
        return {"out": str(self.out), "table": str(self.out / TABLE), "rows": rows}


def fleet(words: Sequence[str], jobs: Jobs | None = None) -> list[dict[str, Any]]:
    """The rows of `forcegp WORDS`, such as ["fit", "--logs-from", "list.txt", "--out", "fleet"].

    {"log", "folder", "error", "cpu_seconds", "warnings", "numbers"} each. `jobs`, in place of that of the
    words, is a number of processes of this machine, or an `Executor` whose workers see the same files, such as Dask's
    `client.get_executor()`. Raises as the command.
    """
    asked = command_of(words)
    if not isinstance(asked, Fleet):
        raise InvalidInput(f"the words {shlex.join(words)!r} name no list of logs; add {FLAG} LIST.")
    return list((asked if jobs is None else replace(asked, jobs=jobs)).run(Quiet())["rows"])


def command_of(words: Sequence[str]) -> Command:
    """The command that words ask for, or the fleet of it. Raises InvalidInput, and as `parsed`."""
    name, asked = words[0] if words else "", any(word.partition("=")[0] == FLAG for word in words)
    many = asked and name in COMMANDS and "logs_from" in options_of(command_class(name))
    if not many or {"-h", "--help"} & set(words):
        return parsed(words)
    own, common = _split([word for word in words[1:] if word not in SWITCHES], (FLAG, "--out", "--jobs"))
    if not (own.get("--out") and own.get(FLAG)):
        raise InvalidInput(f"{FLAG} LIST needs --out FOLDER, a folder for each log. See forcegp {name} --help.")
    jobs = own.get("--jobs", "1")
    if not jobs.isdigit() or jobs == "0":
        raise InvalidInput(f"--jobs is {jobs}; give the number of logs at once, at least 1.")
    given: dict[str, Any] = {word.removeprefix("--"): word in words for word in SWITCHES}
    given |= {"logs_from": Path(own[FLAG]), "out": Path(own["--out"]), "jobs": int(jobs)}
    return Fleet(command=name, common=tuple(common), **given)


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
            error = printable(" ".join(terminal.worded(str(told)).split()))
        except Exception as defect:  # one log must not cost the others theirs
            error = f"an error in forcegp itself, {type(defect).__name__}: {defect}"
    return {"error": error, "warnings": terminal.warnings, "numbers": found}


def numbers_of(content: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Numbers and short texts of what a command found, by their path; estimates by name and value. No settings."""
    found: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, Mapping):
            if "interval_95" in value:
                low, high = value["interval_95"]
                found |= {f"{prefix}{name}": value["value"], f"{prefix}{name}.error_95": 0.5 * (high - low)}
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
        every = [*(row[name] for name in own), len(row["warnings"]), *cells]
        writer.writerow([spreadsheet_cell(cell) if isinstance(cell, str) else cell for cell in every])
    return text.getvalue()


def lines_of(command: str, common: Sequence[str], path: Path, out: Path) -> dict[str, list[str]]:
    """By name, the words of each line of a list. Raises InvalidInput for words of no command, and FileFormatError."""
    lines = dict[str, list[str]]()
    try:
        if why := unreadable(path):
            raise OSError(f"it {why}")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path} cannot be read ({error}); give a text file with a log in each line.") from None
    for number, line in enumerate(text.splitlines(), 1):
        try:
            given = shlex.split(line, comments=True)
            if not given:
                continue
            words = [*_split(common, [word.partition("=")[0] for word in given if word.startswith("--")])[1], *given]
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
