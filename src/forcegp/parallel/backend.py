"""What every backend offers: `map` for equal pieces of work, and a pool for those that depend on each other.

`Serial` works in this process, `Joblib` in processes on this machine, kept between calls.
"""

import os
import sys
import threading
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from typing_extensions import override

from forcegp.errors import BackendError, InvalidInput, WorkerWarning

Outcome = TypeVar("Outcome")

MOST_DEATHS = 3
"""So often a task whose worker died begins anew; the death after these is an error."""


class Pool(ABC):
    """Up to `jobs` tasks at work. Use it as a context manager: leaving it by an error stops what is at work."""

    def __init__(self, jobs: int | float) -> None:
        self._jobs = jobs
        self._at_work: dict[Any, Any] = {}
        """What stands for each task, and what it is."""

    @property
    def free(self) -> int | float:
        """How many more tasks can be at work now; infinite where the backend keeps its own queue."""
        return self._jobs - len(self._at_work)

    def __len__(self) -> int:
        """How many tasks are at work."""
        return len(self._at_work)

    @abstractmethod
    def submit(self, key: Hashable, function: Callable[..., Any], *arguments: Any) -> None:
        """Begin `function(*arguments)` under a key that no other task at work has."""

    @abstractmethod
    def finished(self) -> list[tuple[Any, Future[Any]]]:
        """Wait until a task has ended; keys and finished futures of all that have, with an outcome or an exception.

        Raises BackendError if the workers of a task died more than MOST_DEATHS times.
        """

    @abstractmethod
    def stop(self) -> None:
        """End what is at work and return when no task runs any longer."""

    def __enter__(self) -> "Pool":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self.stop()


class Backend(ABC):
    """Where work is done. Equal tasks have equal outcomes on every backend, in the order of the arguments.

    Functions, arguments and outcomes travel by pickle. An exception that a task raises passes through; a worker that
    dies (killed, out of memory, its machine lost) does not: its task begins anew, MOST_DEATHS times at most.
    Every worker computes on one thread.
    """

    # These constructors are the check, with messages for people; run-time checks of annotations come too early.
    __no_type_check__: ClassVar[bool] = True
    name: ClassVar[str]

    @abstractmethod
    def pool(self) -> Pool:
        """A pool to submit tasks to; its workers are kept for the next one."""

    def map(self, function: Callable[[Any], Outcome], arguments: Iterable[Any]) -> Iterator[Outcome]:
        """`function(argument)` of every argument in their order, each as soon as it and all before it are there.

        Raises what a task raised, in its place; BackendError where workers cannot be had or die again and again.
        """
        waiting, more = enumerate(arguments), True
        ended: dict[int, Future[Outcome]] = {}
        following = 0
        with self.pool() as pool:
            while more or len(pool):
                while more and pool.free > 0:
                    index, argument = next(waiting, (None, None))
                    more = index is not None
                    if more:
                        pool.submit(index, function, argument)
                while following in ended:
                    yield ended.pop(following).result()
                    following += 1
                if len(pool):
                    ended.update(pool.finished())
            for index in sorted(ended):
                yield ended[index].result()


@dataclass(frozen=True)
class Serial(Backend):
    """One task after the other in this process, on as many threads as it has."""

    name: ClassVar[str] = "serial"

    @override
    def pool(self) -> Pool:
        return _ThisProcess(1)


class _ThisProcess(Pool):
    """A task begins when its outcome is asked for."""

    @override
    def submit(self, key: Hashable, function: Callable[..., Any], *arguments: Any) -> None:
        self._at_work[key] = function, arguments

    @override
    def finished(self) -> list[tuple[Any, Future[Any]]]:
        key, (function, arguments) = self._at_work.popitem()
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return [(key, future)]

    @override
    def stop(self) -> None:
        self._at_work.clear()


def check_jobs(jobs: object) -> None:
    """Raises InvalidInput for anything but a whole number of at least 1."""
    if not isinstance(jobs, int) or isinstance(jobs, bool) or jobs < 1:
        raise InvalidInput(f"jobs is {jobs!r}; give the number of tasks at once, at least 1")


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
        outcome = function(*arguments)
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


class _Processes(Pool):
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
            alive = [(task.key, future) for future, task in tasks if task not in died]
            whole = [(key, each if each.exception() is not None else replayed(*each.result())) for key, each in alive]
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
    if jobs is not None and jobs != getattr(given, "jobs", 1):
        raise InvalidInput(f"jobs={jobs} contradicts backend={given}; give one of them")
    return given
