"""What runs in a worker: one thread, and warnings that reach the caller."""

from __future__ import annotations

import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

from forcegp.parallel.backend import unshared

ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "BLIS")}
"""Environment of a worker; the libraries read it when they are loaded."""

RecordedWarning = tuple[str, type[Warning], str, int]
"""A warning: its text, category, file and line."""

_SHOWN: dict[Any, Any] = {}
"""What has been shown, so that each warning of a line of code is shown once, as in one process."""


def use_one_thread() -> None:
    """Workers share the cores, and threads that outnumber these slow each other down."""
    from threadpoolctl import threadpool_limits

    os.environ.update(ONE_THREAD)  # for libraries that are loaded later
    threadpool_limits(1)  # for those that are loaded already
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


def begin_process(parent: int) -> None:
    """One thread, and no life without the parent: a killed run must not go on in its children."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its children itself
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    use_one_thread()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def recorded(function: Callable[..., Any], arguments: Sequence[Any]) -> tuple[Any, list[RecordedWarning]]:
    """The outcome, and every warning on the way."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        outcome = function(*unshared(arguments))
    return outcome, [(str(each.message), each.category, each.filename, each.lineno) for each in caught]


def replayed(outcome: Any, warned: Sequence[RecordedWarning]) -> Future[Any]:
    """The outcome after its warnings have been given here; where these are errors, the first is the exception."""
    future: Future[Any] = Future()
    try:
        for text, category, file, line in warned:
            warnings.warn_explicit(text, category, file, line, registry=_SHOWN)
    except Warning as error:
        future.set_exception(error)
    else:
        future.set_result(outcome)
    return future
