"""`forcegp`: read the arguments, run one command, and turn every failure into one line and an exit code."""

import contextlib
import difflib
import errno
import importlib
import io
import os
import re
import signal
import sys
import traceback
import warnings
from collections.abc import Mapping, Sequence
from itertools import takewhile

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes

from forcegp.cli.command import Command, options_of, values_of, with_texts
from forcegp.cli.terminal import Terminal, with_option_names
from forcegp.errors import ForceGPError, InvalidInput

DESCRIPTION = """Learn the forces that a robot model lacks: friction, payload, cables.

Begin with:
  forcegp demo

or step by step:
  forcegp simulate kuka-surface --seconds 100 --seed 1 --out train.h5
  forcegp simulate kuka-surface --seconds 100 --seed 2 --out test.h5
  forcegp fit train.h5 --points 100 --out run
  forcegp score run test.h5 --out scores

Every command has --help, --json, --overwrite and --debug, and takes lists with commas, as in --forces a,b."""

COMMANDS: Mapping[str, str] = {
    "auto": "go from logs and a URDF to a validated model, in one command",
    "demo": "simulate, learn, score and report, in a minute",
    "simulate": "make a dataset with ground truth",
    "import": "make a dataset from logs (CSV, ROS bags, ...), and filter it",
    "robot": "show a robot file: tree, limits, masses, repairs, and a picture",
    "check": "find mistakes in a log, with the correction of each",
    "fit": "find what a model leaves open: coefficients, bodies, unknown forces",
    "payload": "estimate mass, centre of mass and inertia of a payload",
    "score": "score and compare models on time that they have not seen",
    "view": "show a recording and its learned forces in 3D, in the browser",
    "monitor": "find contacts in a log without a force sensor: time, link and force",
    "excite": "the most informative motion to record next",
    "export": "write a fitted model as a C program",
}
"""A new command is an entry here, and a module of that name with a subclass of Command of that name."""
MODULES = {"import": "import_log"}
"""Names that Python does not allow for a module."""
ARGUMENTS: Mapping[str, Mapping[str, str]] = {
    "excite": {"start": "posture", "motions": "tries", "surface": "avoid"},
    "simulate": {"friction": "tool-friction"},
}
"""Arguments in Python, whose messages begin with their name, and options that are called otherwise."""
NOT_NUMBERS = {
    r"invalid literal for int\(\) with base 10": "a whole number",
    "could not convert string to float": "a number",
}
"""What Python calls a text that is no number, and what would be one."""


def command_class(name: str) -> type[Command]:
    """The class of a command; only its own module is imported, so that --help and errors come at once."""
    module = importlib.import_module(f"forcegp.cli.{MODULES.get(name, name)}")
    return getattr(module, name.capitalize())


def front_page() -> str:
    """The page of `forcegp --help`; that of a command is tyro's."""
    rows = [f"  {name.ljust(10)}{summary}" for name, summary in COMMANDS.items()]
    return "\n".join(["usage: forcegp COMMAND [OPTIONS]", "", DESCRIPTION, "", "Commands:", *rows])


def parse_arguments(words: Sequence[str]) -> Command:
    """The command that the words ask for. --help prints and raises SystemExit(0).

    Raises InvalidInput, with a message of one line, for words that make no command.
    """
    name, *others = words or [""]
    if name in ("-h", "--help"):
        print(front_page())
        raise SystemExit(0)
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f" Did you mean {close[0]}?" if close else " Options follow the command." if name.startswith("-") else ""
        what = f"there is no command {name!r}.{hint}" if name else "no command was given."
        raise InvalidInput(f"{what} Available subcommands: {', '.join(COMMANDS)}. See forcegp --help.")
    kind = command_class(name)
    config = (FlagCreatePairsOff, OmitArgPrefixes)
    if {"-h", "--help"} & set(others):
        tyro.cli(with_texts(kind), prog=f"forcegp {name}", args=["--help"], config=config)
    _check_options(name, kind, others)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, prog=f"forcegp {name}", args=others, config=config)
    except SystemExit:
        reason = one_line(complaint.getvalue())
        for pattern, kind_of_number in NOT_NUMBERS.items():
            reason = re.sub(rf"Error parsing (.*?): {pattern}: (.*)\.$", rf"\1 is \2; give {kind_of_number}.", reason)
        raise InvalidInput(f"{reason} See forcegp {name} --help.") from None


def _check_options(name: str, kind: type[Command], words: Sequence[str]) -> None:
    """Raise InvalidInput for options that the command does not have, and for those that are given twice."""
    flags = {flag: option for name, option in options_of(kind).items() if (flag := option.flag(name))}
    given: set[str] = set()
    for word in takewhile("--".__ne__, words):
        flag = word.partition("=")[0].replace("_", "-")
        if not flag.startswith("--"):
            continue
        if flag not in flags:
            close = difflib.get_close_matches(flag, flags, n=1)
            hint = f" Did you mean {close[0]}?" if close else ""
            raise InvalidInput(f"forcegp {name} has no option {flag}.{hint} See forcegp {name} --help.")
        if flag in given and not flags[flag].repeats:
            raise InvalidInput(f"{flag} is given twice; give it once, a list with commas.")
        given.add(flag)


def one_line(box: str) -> str:
    """The sentence inside a box that tyro draws about wrong arguments: without frame, headings and repeated help.

    ╭─ Unrecognized options ─────────────────╮
    │ Unrecognized options: --pionts         │
    │ ────────────────────────────────────── │
    │ Perhaps you meant:                     │
    │     --points N                         │
    │         Train on so many rows.         │
    ╰────────────────────────────────────────╯

    becomes "Unrecognized options: --pionts. Perhaps you meant: --points N." Without such letters the heading stands
    above a line of its own.
    """
    lines = [line.strip("│|")[1:].rstrip() for line in box.splitlines() if not line.startswith(("╭", "╰", "+"))]
    sections: list[list[str]] = [[]]
    for line in lines:
        if line.strip() and not line.strip(" ─-"):
            sections.append([])
        elif line.strip() and not line.startswith(" " * 8):  # what is indented so far is the help of an option
            sections[-1].append(line.strip())
    sections = sections if "╭" in box else sections[1:]
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
        from forcegp import __version__  # 30 ms that only this needs

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
        with Terminal(json=command.json, options=values_of(command)) as terminal, warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: terminal.warn(str(message))
            command.check_paths()
            terminal.result(command.run(terminal))
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _fail(f"interrupted; {(command or Command).interrupted}.", INTERRUPTED, debug)
    except BrokenPipeError:  # the reader of a pipe has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except ForceGPError as error:
        message = with_option_names(str(error), values_of(command) if command else ())
        for argument, option in ARGUMENTS.get(command.name if command else "", {}).items():
            message = re.sub(rf"^{argument} is ", f"--{option} is ", message)
        return _fail(message, USER_ERROR, debug)
    except OSError as error:
        return _fail(f"{error}{_REMEDIES.get(error.errno or 0, '')}", USER_ERROR, debug)
    except MemoryError as error:
        return _fail(f"out of memory ({error}); use fewer points or rows.", USER_ERROR, debug)
    except Exception as error:  # the last resort: one line also for a defect of ours, with its own exit code
        if isinstance(error, ImportError) and "shared object" in str(error):
            remedy = "raise the limit of memory (ulimit -v), or install forcegp again"
            return _fail(f"a library cannot be loaded: {error}; {remedy}.", USER_ERROR, debug)
        what = f"{type(error).__name__}: {error}"
        return _fail(f"an error in forcegp itself, {what} (--debug shows where)", INTERNAL_ERROR, debug)
    finally:  # a program that calls this goes on as it was
        warnings.showwarning = showwarning
        if terminate is not None:
            signal.signal(signal.SIGTERM, terminate)
    return OK


def _fail(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"forcegp: {' '.join(message.split())}", file=sys.stderr)
    return code
