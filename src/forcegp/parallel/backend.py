"""Where work is done: `Serial` in this process, `Joblib` in processes on this machine, kept between calls.

A backend of your own gives `submit` and `stop`, and everything else follows from it.
"""

import os
import sys
import threading
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from typing_extensions import override

from forcegp.errors import BackendError, InvalidInput

Outcome = TypeVar("Outcome")


class Backend(ABC):
    """Where work is done. Equal tasks have equal outcomes on every backend, in the order of the arguments.

    Functions, arguments and outcomes travel by pickle. An exception that a task raises passes through. Every worker
    computes on one thread.
    """

    name: ClassVar[str]
    jobs: int = 1
    """So many tasks are at work at once."""

    @abstractmethod
    def submit(self, function: Callable[..., Outcome], *arguments: Any) -> Future[Outcome]:
        """Begin `function(*arguments)`, now or as soon as a worker is free."""

    @abstractmethod
    def stop(self) -> None:
        """End what is at work, and return when no task runs any longer."""

    def map(self, function: Callable[[Any], Outcome], arguments: Iterable[Any]) -> Iterator[Outcome]:
        """`function(argument)` of every argument in their order, each as soon as it and all before it are there.

        Raises what a task raised, in its place; BackendError where a worker died.
        """
        futures = [self.submit(_recorded, function, argument) for argument in arguments]
        try:
            for future in futures:
                outcome, warned = outcome_of(future)
                for text, category, file, line in warned:
                    warnings.warn_explicit(text, category, file, line, registry=_SHOWN)
                yield outcome
        finally:
            if not all(future.done() for future in futures):
                self.stop()


def outcome_of(future: Future[Outcome]) -> Outcome:
    """What a task returned or raised. Raises BackendError if its worker died (killed, or out of memory)."""
    try:
        return future.result()
    except BrokenProcessPool as error:
        cause = " ".join(str(error).split())
        remedy = "try fewer jobs if memory is short, or backend serial"
        raise BackendError(f"the processes broke off, which ends what was at work; {remedy} ({cause})") from error


_SHOWN: dict[Any, Any] = {}
"""What has been shown, so that each warning of a line of code is shown once, as in one process."""


def _recorded(function: Callable[..., Outcome], argument: Any) -> tuple[Outcome, list[tuple[Any, ...]]]:
    """The outcome, and text, category, file and line of every warning on the way."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        outcome = function(argument)
    return outcome, [(str(each.message), each.category, each.filename, each.lineno) for each in caught]


@dataclass(frozen=True)
class Serial(Backend):
    """One task after the other in this process, on as many threads as it has."""

    name: ClassVar[str] = "serial"

    @override
    def submit(self, function: Callable[..., Outcome], *arguments: Any) -> Future[Outcome]:
        future: Future[Outcome] = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    @override
    def stop(self) -> None:
        pass  # a task has ended when `submit` returns

    @override
    def map(self, function: Callable[[Any], Outcome], arguments: Iterable[Any]) -> Iterator[Outcome]:
        return map(function, arguments)


def check_jobs(jobs: object) -> None:
    """Raises InvalidInput for anything but a whole number of at least 1."""
    if not isinstance(jobs, int) or isinstance(jobs, bool) or jobs < 1:
        raise InvalidInput(f"jobs is {jobs!r}; give the number of tasks at once, at least 1")


ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "BLIS")}
"""Environment of a worker; the libraries read it when they are loaded."""


def begin_process(parent: int) -> None:
    """One thread, and no life without the parent: a killed run must not go on in its children."""
    import signal

    from threadpoolctl import threadpool_limits

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its children itself
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threadpool_limits(1)  # workers share the cores: for libraries that are loaded already
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


IDLE_SECONDS = 300
"""So long processes without work are kept for the next call."""


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
    def submit(self, function: Callable[..., Outcome], *arguments: Any) -> Future[Outcome]:
        return self._executor().submit(function, *arguments)

    @override
    def stop(self) -> None:
        self._executor().shutdown(wait=True, kill_workers=True)

    def _executor(self) -> Any:
        """The processes of the last call, or new ones where a process died or their number has changed."""
        from joblib.externals.loky import get_reusable_executor

        return get_reusable_executor(
            self.jobs, timeout=IDLE_SECONDS, initializer=begin_process, initargs=(os.getpid(),), env=ONE_THREAD
        )


BACKENDS: dict[str, type[Backend]] = {kind.name: kind for kind in (Serial, Joblib)}


def backend_for(given: Backend | str | None, jobs: int | None = None) -> Backend:
    """What a function means that takes both: a backend, its name, or None for processes as soon as jobs is above 1.

    Raises InvalidInput for other names, more than one job of serial, and other jobs beside a backend's own.
    """
    if given is None:
        given = Serial.name if jobs in (None, 1) else Joblib.name
    if isinstance(given, str):
        if given not in BACKENDS:
            raise InvalidInput(f"there is no backend {given!r}; choose {', '.join(BACKENDS)}")
        if jobs is not None:
            check_jobs(jobs)
        if given == Joblib.name:
            return Joblib(os.cpu_count() or 1 if jobs is None else jobs)
        if jobs not in (None, 1):
            raise InvalidInput(f"backend serial does one task at a time, not {jobs}; choose joblib, or leave jobs out")
        return Serial()
    if not isinstance(given, Backend):
        raise InvalidInput(
            f"backend is a {type(given).__name__}; give Serial(), Joblib(jobs), or one of the names "
            f"{', '.join(BACKENDS)}"
        )
    if jobs is not None and jobs != given.jobs:
        raise InvalidInput(f"jobs={jobs} contradicts backend={given}; give one of them")
    return given
