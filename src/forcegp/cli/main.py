"""`forcegp`: read the arguments, run one command, and turn every failure into one line and an exit code."""

from __future__ import annotations

import contextlib
import errno
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
from forcegp.cli.option_names import with_option_names
from forcegp.cli.terminal import Terminal
from forcegp.errors import ForceGPError, NotEnoughMemory

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
        terminate = signal.signal(signal.SIGTERM, _terminate)  # so that temporary files are removed then, too
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


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise SystemExit(128 + number)
