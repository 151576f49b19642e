"""Work at once: `jobs` is 1 for this process, a number of own processes, or any `concurrent.futures.Executor`.

Executors are used as they are: `ProcessPoolExecutor`, Dask's `client.get_executor()`, the pool of Ray or MPI.
"""

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from typing_extensions import override

from forcegp.errors import BackendError, InvalidInput

Outcome = TypeVar("Outcome")
Jobs: TypeAlias = int | Executor

MOST_JOBS = 1024  # of own processes; more machines have executors
IDLE_SECONDS = 300  # so long processes without work are kept for the next call

ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "BLIS")}
"""Environment of an own process; the libraries read it when they are loaded."""


class ThisProcess(Executor):
    """One task after the other, on as many threads as this process has."""

    @override
    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def checked_jobs(jobs: object) -> Jobs:
    """The argument. Raises InvalidInput for anything but an executor or a whole number from 1 to `MOST_JOBS`."""
    if isinstance(jobs, Executor) or (isinstance(jobs, int) and not isinstance(jobs, bool) and 1 <= jobs <= MOST_JOBS):
        return jobs
    raise InvalidInput(f"jobs is {jobs!r}; give the number of tasks at once, 1 to {MOST_JOBS}, or an Executor")


def executor_for(jobs: Jobs) -> Executor:
    """Where so many tasks run at once. Raises as `checked_jobs`."""
    jobs = checked_jobs(jobs)
    return jobs if isinstance(jobs, Executor) else ThisProcess() if jobs == 1 else _own_processes(jobs)


def mapped(function: Callable[[Any], Outcome], arguments: Iterable[Any], jobs: Jobs) -> Iterator[Outcome]:
    """`function(argument)` of every argument in their order, each as soon as it and all before it are there.

    Raises what a task raised, in its place; as `checked_jobs`; BackendError where a process died or a task cannot
    travel. What is at work ends with the iterator: own processes by force, others when their tasks end.
    """
    executor, futures = executor_for(jobs), list[Future[Any]]()
    if isinstance(executor, ThisProcess):
        yield from map(function, arguments)
        return
    try:
        futures += [submit(executor, function, argument) for argument in arguments]
        for future in futures:
            yield outcome_of(future)
    finally:
        stop(executor, futures)


def submit(executor: Executor, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """Begin a task for `outcome_of`. BackendError for what cannot travel, and where a process has died."""
    if isinstance(executor, ThisProcess):
        return executor.submit(function, *arguments)
    import cloudpickle

    try:
        task = cloudpickle.dumps((function, arguments))
    except Exception as error:  # whatever the objects raise
        told = " ".join(str(error).split())
        raise BackendError(f"this work cannot be sent to another process ({told}); use jobs=1") from error
    with _told_of_dead_processes():
        return executor.submit(_run, task)


def outcome_of(future: Future[Any]) -> Any:
    """What a task returned or raised. Raises BackendError if its process died (killed, memory)."""
    with _told_of_dead_processes():
        return future.result()


@contextlib.contextmanager
def _told_of_dead_processes() -> Iterator[None]:
    try:
        yield
    except BrokenExecutor as error:
        cause, remedy = " ".join(str(error).split()), "try fewer jobs if memory is short, or jobs=1"
        raise BackendError(f"the processes broke off, which ends what was at work; {remedy} ({cause})") from error


def _run(task: bytes) -> Any:
    import cloudpickle

    function, arguments = cloudpickle.loads(task)
    return function(*arguments)


_own: Executor | None = None


def _own_processes(jobs: int) -> Executor:
    """The processes of the last call; new ones where one died, or their number or the folder of this one changed."""
    from joblib.externals.loky import get_reusable_executor

    global _own
    here = os.getpid(), Path.cwd()
    _own = get_reusable_executor(jobs, timeout=IDLE_SECONDS, initializer=_begin_process, initargs=here, env=ONE_THREAD)
    return _own


def _begin_process(parent: int, folder: Path) -> None:
    """One thread, and no life without the parent: a killed run must not go on in its children."""
    import signal

    from threadpoolctl import threadpool_limits

    os.chdir(folder)  # relative paths are those of the parent
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its children itself
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threadpool_limits(1)  # processes share the cores: for libraries that are loaded already
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def stop(executor: Executor, futures: Collection[Future[Any]]) -> None:
    """Cancel what has not begun; own processes that are at work end, and are new at the next call."""
    for future in futures:
        future.cancel()
    if executor is not _own or all(future.done() for future in futures):
        return
    import psutil

    # Not `shutdown(kill_workers=True)`: loky then looks for cancelled tasks that it has forgotten, and raises in its
    # thread. A process that dies is what it handles at any time.
    for process in list(getattr(executor, "_processes", ())):
        with contextlib.suppress(psutil.NoSuchProcess):
            psutil.Process(process).kill()
    executor.shutdown(wait=True)
