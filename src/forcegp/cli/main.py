"""`forcegp`: read the arguments, run one command, and turn every failure into one line and an exit code."""

import contextlib
import errno
import os
import re
import signal
import sys
import traceback
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

try:
    from forcegp.cli.arguments import parsed
    from forcegp.cli.command import Command, values_of
    from forcegp.cli.terminal import Terminal, with_option_names
    from forcegp.errors import ForceGPError, lacks_memory, printable
except KeyboardInterrupt:  # in the first tenth of a second, before `main` could tell
    print("forcegp: interrupted; nothing was begun.", file=sys.stderr)
    raise SystemExit(130) from None

ARGUMENTS: Mapping[str, Mapping[str, str]] = {
    "excite": {"start": "posture", "motions": "tries", "surface": "avoid"},
    "simulate": {"friction": "tool-friction"},
}
"""Arguments in Python, whose messages begin with their name, and options that are called otherwise."""


def parse_arguments(words: Sequence[str]) -> Command:
    """The command that the words ask for, or a fleet of it. --help prints and raises SystemExit(0)."""
    if any(word.startswith("--logs-from") for word in words):
        from forcegp.cli.fleet import command_of  # which most calls do without

        return command_of(words)
    return parsed(words)


OK, INTERNAL_ERROR, USER_ERROR, INTERRUPTED = 0, 1, 2, 130
_REMEDIES = dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "; free some space, or write elsewhere.")
_REMEDIES |= dict.fromkeys(
    (errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR), "; write to a folder where you may."
)
_REMEDIES[errno.EEXIST] = ", where a folder is needed: a file, or a link to nothing; remove it, or write elsewhere."
"""What to do about an OSError, by its number."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `forcegp` with these arguments (default: those of the process) and return its exit code.

    0 ok, 2 an error that the user can mend, 130 interrupted, 1 an error in forcegp itself.
    """
    for name in ("stdin", "stdout", "stderr"):  # one that is closed: what would be shown goes nowhere
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), "r" if name == "stdin" else "w"))
    given = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:  # this process draws in files alone, and matplotlib refuses names that it does not know
        os.environ.pop("MPLBACKEND", None)
    if given == ["--version"]:
        from forcegp import __version__  # 30 ms that only this needs

        print(f"forcegp {__version__}")
        return OK
    debug, command = "--debug" in given, None
    if arguments is None and sys.warnoptions:  # -W and PYTHONWARNINGS: what a library calls is no error of its user
        warnings.resetwarnings()
        warnings.simplefilter("ignore", DeprecationWarning)
    if not (epoch := os.environ.get("SOURCE_DATE_EPOCH", "0")).isdigit():  # which libraries read when imported
        return _fail(f"SOURCE_DATE_EPOCH is {epoch!r}; give whole seconds, or unset it.", USER_ERROR, debug)
    showwarning, terminate = warnings.showwarning, None
    stdout: Any = sys.stdout
    errors = getattr(stdout, "errors", None)
    with contextlib.suppress(AttributeError):  # of a notebook, which takes every letter
        stdout.reconfigure(errors="replace")  # letters that its encoding lacks: the result counts, not its signs
    with contextlib.suppress(ValueError):  # not in the main thread
        # so that temporary files are removed then, too
        terminate = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        # `forcegp --debug fit ...` means the same as `forcegp fit ... --debug`
        command = parse_arguments([*(word for word in given if word != "--debug"), *(["--debug"] if debug else [])])
        with Terminal(json=command.json, options=values_of(command)) as terminal, warnings.catch_warnings():
            # of NumPy, about numbers that a sentence of ours refuses, or that are not finite where they are shown
            warnings.filterwarnings("ignore", "(overflow|invalid value|divide by zero) encountered", RuntimeWarning)
            warnings.showwarning = lambda message, *_, **__: terminal.warn(str(message))
            command.check_paths()
            with command.alone():
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
    except Exception as error:  # the last resort: one line also for a defect of ours, with its own exit code
        if lacks_memory(error):
            return _fail(f"out of memory ({error}); use fewer points or rows.", USER_ERROR, debug)
        if isinstance(error, ImportError) and "shared object" in str(error):
            remedy = "raise the limit of memory (ulimit -v), or install forcegp again"
            return _fail(f"a library cannot be loaded: {error}; {remedy}.", USER_ERROR, debug)
        what = f"{type(error).__name__}: {error}"
        return _fail(f"an error in forcegp itself, {what} (--debug shows where)", INTERNAL_ERROR, debug)
    finally:  # a program that calls this goes on as it was
        warnings.showwarning = showwarning
        with contextlib.suppress(AttributeError, OSError):  # a full disk
            stdout.reconfigure(errors=errors)
        if terminate is not None:
            signal.signal(signal.SIGTERM, terminate)
    return OK


def _fail(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    with contextlib.suppress(OSError):  # a full disk
        print(f"forcegp: {printable(' '.join(message.split()))}", file=sys.stderr)
    return code
