"""`Joblib`: processes on this machine, kept between calls."""

from __future__ import annotations

import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import override

from forcegp.errors import BackendError, WorkerWarning
from forcegp.parallel.backend import MOST_DEATHS, Backend, Pool, Workers, check_jobs, unshared

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


IDLE_SECONDS = 300
"""So long processes without work are kept for the next call."""

HANDED_OVER = 5.0
"""Seconds in which a task is handed over to a process at the latest."""


@dataclass(frozen=True)
class Joblib(Backend):
    """`jobs` processes on this machine (those of joblib, which can also carry functions of a script).

    The first call starts them; they are kept for the calls that follow, and end with this process.
    """

    name: ClassVar[str] = "joblib"
    jobs: int

    def __post_init__(self) -> None:
        check_jobs(self.jobs)

    @override
    def pool(self) -> Pool:
        return _Processes(self.jobs)


@dataclass(eq=False)
class _Task:
    key: Hashable
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    deaths: int = 0


class _Processes(Workers):
    # As many tasks as there are processes: one that dies takes all tasks with it that were handed over.

    @override
    def submit(self, key: Hashable, function: Callable[..., Any], *arguments: Any) -> None:
        self._begin(_Task(key, function, arguments))

    @override
    def finished(self) -> list[tuple[Any, Future[Any]]]:
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        while True:
            ended, _ = wait(self._at_work, return_when=FIRST_COMPLETED)
            tasks = [(future, self._at_work.pop(future)) for future in ended]
            # Other breaks of the pool are exceptions of the task: for example what a worker cannot unpickle.
            died = [task for future, task in tasks if isinstance(future.exception(), TerminatedWorkerError)]
            if died:
                self._begin_again(died)
            whole = [(task.key, _with_warnings(future)) for future, task in tasks if task not in died]
            if whole:
                return whole

    @override
    def stop(self) -> None:
        if self._at_work:
            # joblib's own thread raises a KeyError where it is stopped before it has handed a task over
            last = time.monotonic() + HANDED_OVER
            while time.monotonic() < last and not all(task.running() or task.done() for task in self._at_work):
                time.sleep(0.001)
            self._executor().shutdown(wait=True, kill_workers=True)
            self._at_work.clear()

    def _executor(self) -> Any:
        """The processes of the last call, or new ones where a process died or their number has changed."""
        from joblib.externals.loky import get_reusable_executor

        return get_reusable_executor(
            self._jobs, timeout=IDLE_SECONDS, initializer=begin_process, initargs=(os.getpid(),), env=ONE_THREAD
        )

    def _begin(self, task: _Task) -> None:
        try:
            future = self._executor().submit(recorded, task.function, task.arguments)
        except BrokenProcessPool:  # it died since the last look; asked again, joblib makes a new one
            future = self._executor().submit(recorded, task.function, task.arguments)
        self._at_work[future] = task

    def _begin_again(self, tasks: list[_Task]) -> None:
        names = ", ".join(str(task.key) for task in tasks)
        for task in tasks:
            task.deaths += 1
        if max(task.deaths for task in tasks) > MOST_DEATHS:
            raise BackendError(
                f"a process died {MOST_DEATHS + 1} times while task {names} was at work, probably for want of memory; "
                "try fewer jobs if memory is short"
            )
        warnings.warn(
            f"a process died while task {names} was at work (killed, or out of memory); it begins anew",
            WorkerWarning,
            stacklevel=3,
        )
        for task in tasks:
            self._begin(task)


def _with_warnings(future: Future[Any]) -> Future[Any]:
    return future if future.exception() is not None else replayed(*future.result())
