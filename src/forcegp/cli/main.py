"""`forcegp`: read the arguments, run one command, and turn every failure into one line and an exit code."""

import contextlib
import difflib
import errno
import io
import os
import shutil
import signal
import sys
import textwrap
import traceback
import warnings
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import tyro
from tyro.conf import FlagCreatePairsOff, subcommand

from forcegp import __version__
from forcegp.cli.auto import Auto
from forcegp.cli.check import Check
from forcegp.cli.command import Command
from forcegp.cli.compare import Compare
from forcegp.cli.demo import Demo
from forcegp.cli.evaluate import Evaluate
from forcegp.cli.excite import Excite
from forcegp.cli.export import Export
from forcegp.cli.fit import Fit
from forcegp.cli.identify import Identify
from forcegp.cli.import_log import Import
from forcegp.cli.monitor import Monitor
from forcegp.cli.payload import Payload
from forcegp.cli.prepare import Prepare
from forcegp.cli.reproduce import Reproduce
from forcegp.cli.rollout import Rollout
from forcegp.cli.simulate import Simulate
from forcegp.cli.terminal import Terminal, with_option_names
from forcegp.cli.validate import Validate
from forcegp.errors import ForceGPError, InvalidInput, NotEnoughMemory

DESCRIPTION = """Learn the forces that nobody modelled, inside the rigid-body dynamics that are known.

Begin with:
  forcegp demo

or step by step:
  forcegp simulate kuka-surface --seconds 100 --seed 1 --out train.h5
  forcegp simulate kuka-surface --seconds 100 --seed 2 --out test.h5
  forcegp fit train.h5 --points 100 --out run
  forcegp evaluate run test.h5 --plots figures

Every command has --help, --json and --debug. forcegp --version prints the version."""

COMMANDS: dict[str, tuple[type[Command], str]] = {
    "auto": (Auto, "from logs and a URDF to a validated model, in one command"),
    "demo": (Demo, "the whole story in a minute: simulate, learn, evaluate, draw"),
    "simulate": (Simulate, "make a dataset with ground truth"),
    "import": (Import, "make a dataset of logs: CSV, Parquet, npz, MATLAB, HDF5, ROS bags, LeRobot"),
    "check": (Check, "what would spoil a model of this log, and what to do about it"),
    "prepare": (Prepare, "filter and differentiate a raw log, and report what that costs"),
    "fit": (Fit, "learn the unknown forces from a dataset"),
    "compare": (Compare, "which kind of unknown force the data support"),
    "identify": (Identify, "estimate masses, inertias and friction coefficients, and their standard errors"),
    "payload": (Payload, "mass, centre of mass and inertia of what the robot holds"),
    "evaluate": (Evaluate, "score a fitted model on another dataset"),
    "validate": (Validate, "models side by side on rows of a log that none of them has seen"),
    "rollout": (Rollout, "predict whole motions and compare them with the recorded ones"),
    "monitor": (Monitor, "when a robot was touched, where and how hard, from a log without force sensor"),
    "excite": (Excite, "the next motion to record: the one that teaches most"),
    "export": (Export, "write a fitted model as a C program"),
    "reproduce": (Reproduce, "every figure and number of the paper, from one command"),
}
"""A new command is a file with a subclass of Command, and an entry here."""


def parse_arguments(words: Sequence[str]) -> Command:
    """The command that the words ask for. `--help` prints and raises SystemExit(0).

    Raises InvalidInput, with a message of one line, for words that make no command.
    """
    if words and words[0] in COMMANDS:
        kind, _ = COMMANDS[words[0]]
        return _parse(kind, words[1:], prog=f"forcegp {words[0]}")
    if words and not words[0].startswith("-"):
        close = difflib.get_close_matches(words[0], COMMANDS, n=1)
        hint = f" Did you mean {close[0]}?" if close else ""
        raise InvalidInput(f"there is no command {words[0]!r}.{hint} Available subcommands: {', '.join(COMMANDS)}.")
    kinds: Any = None
    for name, (kind, summary) in COMMANDS.items():
        kind = Annotated[kind, subcommand(name, description=summary, prefix_name=False)]
        kinds = kind if kinds is None else kinds | kind
    return _parse(kinds, words, prog="forcegp", description=DESCRIPTION)


def _parse(kind: Any, words: Sequence[str], prog: str, description: str | None = None) -> Command:
    complaint, shown, width = (
        io.StringIO(),
        _Shown(io.BytesIO(), sys.stdout.encoding or "utf-8", "replace"),
        min(WIDEST, shutil.get_terminal_size().columns),
    )
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(width)  # which tyro reads
    try:
        with contextlib.redirect_stderr(complaint), contextlib.redirect_stdout(shown):
            return tyro.cli(kind, prog=prog, description=description, args=words, config=(FlagCreatePairsOff,))
    except SystemExit as end:
        if not end.code:
            names = "{" + ",".join(COMMANDS) + "}"
            print("\n".join(wrapped(shown.text().replace(names, "COMMAND"), width)))
            raise
        raise InvalidInput(f"{one_line(complaint.getvalue())} See {prog} --help.") from None
    finally:
        del os.environ["COLUMNS"]
        os.environ |= {} if before is None else {"COLUMNS": before}


class _Shown(io.TextIOWrapper):
    """What would go to stdout: tyro draws the boxes and colors that fit there."""

    def isatty(self) -> bool:
        return sys.__stdout__ is not None and sys.__stdout__.isatty()

    def text(self) -> str:
        """All of it so far."""
        self.flush()
        self.seek(0)
        return self.read()


WIDEST = 100
"""Columns of a help page at most."""


def wrapped(text: str, width: int) -> Iterator[str]:
    """The lines of a help page within so many columns: paragraphs at words, commands so that they can be pasted."""
    options: dict[str, Any] = {"break_on_hyphens": False, "break_long_words": False}
    for line in text.rstrip("\n").split("\n"):
        if len(line) <= width or line.lstrip()[:1] in BOX:
            yield line
        elif line.startswith(" "):
            yield from " \\\n".join(textwrap.wrap(line, width - 2, subsequent_indent="      ", **options)).split("\n")
        else:
            yield from textwrap.wrap(line, width, **options)


BOX = ("\x1b", "│", "╭", "╰", "├", "|", "+")  # what begins a line of a box, which has its width


def one_line(box: str) -> str:
    """The sentence inside a box that tyro draws about wrong arguments: without frame, headings and repeated help.

    ╭─ Unrecognized options ─────────────────╮
    │ Unrecognized options: --pionts         │
    │ ────────────────────────────────────── │
    │ Perhaps you meant:                     │
    │     --points N                         │
    │         Train on so many rows.         │
    ╰────────────────────────────────────────╯

    becomes "Unrecognized options: --pionts. Perhaps you meant: --points N."
    """
    lines = [line.strip("│|")[1:].rstrip() for line in box.splitlines() if not line.startswith(("╭", "╰", "+"))]
    sections: list[list[str]] = [[]]
    for line in lines:
        if line.strip("─-") == "" and line:
            sections.append([])
        elif line.strip() and not line.startswith(" " * 8):  # what is indented so far is the help of an option
            sections[-1].append(line.strip())
    sentences = [" ".join(section) for section in sections if section]
    sentences = [section for section in sentences if not section.startswith(("For full helptext", "Argument helptext"))]
    return " ".join(section if section.endswith(".") else f"{section}." for section in sentences)


OK, INTERNAL_ERROR, USER_ERROR, INTERRUPTED = 0, 1, 2, 130


_FULL, _ELSEWHERE = "; free some space, or write elsewhere.", "; write to a folder where you may."
_REMEDIES = dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), _FULL)
_REMEDIES |= dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR), _ELSEWHERE)
"""What to do about an OSError, by its number."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `forcegp` with these arguments (default: those of the process) and return its exit code.

    0 ok, 2 an error that the user can mend, 130 interrupted, 1 an error in forcegp itself.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        print(f"forcegp {__version__}")
        return OK
    debug, command = "--debug" in given, None
    showwarning, terminate = warnings.showwarning, None
    with contextlib.suppress(ValueError):  # not in the main thread
        # so that temporary files are removed then, too
        terminate = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        # `forcegp --debug fit ...` means the same as `forcegp fit ... --debug`
        command = parse_arguments([*(word for word in given if word != "--debug"), *(["--debug"] if debug else [])])
        with Terminal(json=command.json, options=command.options) as terminal, warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: terminal.warn(str(message))
            command.check_paths()
            _require_address_space()
            terminal.result(command.run(terminal))
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _fail(f"interrupted; {(command or Command).interrupted}.", INTERRUPTED, debug)
    except BrokenPipeError:  # the reader of a pipe has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except ForceGPError as error:
        return _fail(with_option_names(str(error), command.options if command else ()), USER_ERROR, debug)
    except OSError as error:
        return _fail(f"{error}{_REMEDIES.get(error.errno or 0, '')}", USER_ERROR, debug)
    except MemoryError as error:
        return _fail(f"out of memory ({error}); use fewer points or rows.", USER_ERROR, debug)
    except Exception as error:  # the last resort: one line also for a defect of ours, with its own exit code
        what = f"{type(error).__name__}: {error}"
        return _fail(f"an error in forcegp itself, {what} (--debug shows where)", INTERNAL_ERROR, debug)
    finally:  # a program that calls this goes on as it was
        warnings.showwarning = showwarning
        if terminate is not None:
            signal.signal(signal.SIGTERM, terminate)
    return OK


def _require_address_space() -> None:
    """Refuse a limit (`ulimit -v`) in which the libraries do not fit.

    OpenBLAS, while it is loaded, asks for its buffers again and again and for ever. Raises NotEnoughMemory.
    """
    if sys.platform == "win32" or "torch" in sys.modules:
        return
    import mmap
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    given = os.environ.get("OPENBLAS_NUM_THREADS") or os.environ.get("OMP_NUM_THREADS") or ""
    threads = min(int(given) if given.isdecimal() else 64, os.cpu_count() or 1)
    needed = (820 + 80 * threads) << 20
    if limit != resource.RLIM_INFINITY:
        try:
            mmap.mmap(-1, needed).close()
        except OSError:
            raise NotEnoughMemory(
                f"the address space is limited to {limit >> 20} MiB (ulimit -v), and {needed >> 20} MiB more are "
                "needed to begin with; raise the limit."
            ) from None


def _fail(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"forcegp: {' '.join(message.split())}", file=sys.stderr)
    return code
