"""`forcegp`: read the arguments, run one command, and turn every failure into one line and an exit code."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Sequence
from types import FrameType
from typing import NoReturn

from forcegp import __version__
from forcegp.cli.arguments import parse_arguments
from forcegp.cli.command import Command
from forcegp.cli.terminal import Terminal
from forcegp.errors import ForceGPError

OK, INTERNAL_ERROR, USER_ERROR, INTERRUPTED = 0, 1, 2, 130


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
        terminate = signal.signal(signal.SIGTERM, _terminate)  # so that temporary files are removed then, too
    try:
        # `forcegp --debug fit ...` means the same as `forcegp fit ... --debug`
        command = parse_arguments([*(word for word in given if word != "--debug"), *(["--debug"] if debug else [])])
        with Terminal(json=command.json) as terminal, warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: terminal.warn(str(message))
            command.check_inputs()
            terminal.result(command.run(terminal))
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _fail(f"interrupted; {(command or Command).interrupted}.", INTERRUPTED, debug)
    except BrokenPipeError:  # the reader of a pipe has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except (ForceGPError, OSError) as error:
        return _fail(str(error), USER_ERROR, debug)
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


def _fail(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"forcegp: {' '.join(message.split())}", file=sys.stderr)
    return code


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise SystemExit(128 + number)
