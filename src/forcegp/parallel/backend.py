"""What every backend offers: `map` for equal pieces of work, and a pool for those that depend on each other."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from types import TracebackType
from typing import Any, ClassVar, TypeVar

from typing_extensions import override

from forcegp.errors import InvalidInput

Outcome = TypeVar("Outcome")

MOST_DEATHS = 3
"""So often a task whose worker died begins anew; the death after these is an error."""


@dataclass(frozen=True, eq=False)
class Shared:
    """An argument that many tasks of a pool have in common; a cluster receives it once. The task gets the `value`."""

    value: Any


class Pool(ABC):
    """Tasks at work. Use it as a context manager: leaving it by an error stops what is at work."""

    @property
    @abstractmethod
    def free(self) -> int | float:
        """How many more tasks can be at work now; infinite where the backend keeps its own queue."""

    @abstractmethod
    def __len__(self) -> int:
        """How many tasks are at work."""

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

    def __enter__(self) -> Pool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is not None:
            self.stop()


class Workers(Pool):
    """A pool of up to `jobs` tasks at once in other processes; `_at_work` maps what stands for each to what it is."""

    def __init__(self, jobs: int | float) -> None:
        self._jobs = jobs
        self._at_work: dict[Any, Any] = {}

    @property
    @override
    def free(self) -> int | float:
        return self._jobs - len(self._at_work)

    @override
    def __len__(self) -> int:
        return len(self._at_work)


class Backend(ABC):
    """Where work is done. Equal tasks have equal outcomes on every backend, in the order of the arguments.

    Functions, arguments and outcomes travel by pickle. An exception that a task raises passes through; a worker that
    dies (killed, out of memory, its machine lost) does not: its task begins anew, MOST_DEATHS times at most.
    Every worker computes on one thread.
    """

    # These constructors are the check, with messages for people; run-time checks of annotations come too early.
    __no_type_check__: ClassVar[bool] = True
    name: ClassVar[str]
    shares_files: ClassVar[bool] = True
    """Whether a task finds the files of this machine."""

    @abstractmethod
    def pool(self) -> Pool:
        """A pool to submit tasks to; its workers are kept for the next one."""

    def map(self, function: Callable[[Any], Outcome], arguments: Iterable[Any]) -> Iterator[Outcome]:
        """`function(argument)` of every argument in their order, each as soon as it and all before it are there.

        Raises what a task raised, in its place; BackendError where workers cannot be had or die again and again.
        """
        waiting = enumerate(arguments)
        ended: dict[int, Future[Outcome]] = {}
        following, more = 0, True
        with self.pool() as pool:
            while True:
                while more and pool.free > 0:
                    index, argument = next(waiting, (None, None))
                    more = index is not None
                    if more:
                        pool.submit(index, function, argument)
                while following in ended:
                    yield ended.pop(following).result()
                    following += 1
                if not len(pool) and not more:
                    return
                if len(pool):
                    ended.update(pool.finished())


@dataclass(frozen=True)
class Serial(Backend):
    """One task after the other in this process, on as many threads as it has."""

    name: ClassVar[str] = "serial"

    @override
    def pool(self) -> Pool:
        return _ThisProcess()


class _ThisProcess(Pool):
    """A task begins when its outcome is asked for."""

    def __init__(self) -> None:
        self._task: tuple[Hashable, Callable[..., Any], tuple[Any, ...]] | None = None

    @property
    @override
    def free(self) -> int | float:
        return 0 if self._task else 1

    @override
    def __len__(self) -> int:
        return 1 if self._task else 0

    @override
    def submit(self, key: Hashable, function: Callable[..., Any], *arguments: Any) -> None:
        assert self._task is None, "one task at a time"
        self._task = key, function, arguments

    @override
    def finished(self) -> list[tuple[Any, Future[Any]]]:
        assert self._task is not None, "no task was submitted"
        (key, function, arguments), self._task = self._task, None
        future: Future[Any] = Future()
        try:
            future.set_result(function(*unshared(arguments)))
        except Exception as error:
            future.set_exception(error)
        return [(key, future)]

    @override
    def stop(self) -> None:
        self._task = None


def unshared(arguments: Iterable[Any]) -> tuple[Any, ...]:
    """The arguments as the function is to see them."""
    return tuple(argument.value if isinstance(argument, Shared) else argument for argument in arguments)


def check_jobs(jobs: object) -> None:
    """Raises InvalidInput for anything but a whole number of at least 1."""
    if not isinstance(jobs, int) or isinstance(jobs, bool) or jobs < 1:
        raise InvalidInput(f"jobs is {jobs!r}; give the number of tasks at once, at least 1")
