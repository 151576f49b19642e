"""`Ray`: the machines of a Ray cluster."""

from __future__ import annotations

import inspect
import platform
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from dataclasses import dataclass
from importlib import metadata
from typing import Any, ClassVar

from typing_extensions import override

from forcegp.errors import BackendError
from forcegp.parallel.backend import MOST_DEATHS, Backend, Pool, Shared, Workers, check_jobs
from forcegp.parallel.connection import connected, host_and_port
from forcegp.parallel.worker import replayed

DECIDING = ("forcegp", "torch", "gpytorch", "numpy", "scipy")
"""Packages that decide what a task computes; every machine has to have the versions of the caller."""

INTERRUPTIBLE_SECONDS = 1.0
"""So often a wait lets Python look for signals."""


@dataclass(frozen=True)
class Ray(Backend):
    """The processors of a Ray cluster, `jobs` of them at once (None: as many as it has).

    address: HOST:PORT of the head; None is the cluster of this machine, or a new one of this machine alone. Tasks that
    are lost with their worker or their machine begin anew elsewhere. Every machine needs the same versions of forcegp,
    torch, gpytorch, numpy, scipy and Python; a task on another raises BackendError.
    """

    name: ClassVar[str] = "ray"
    shares_files: ClassVar[bool] = False
    address: str | None = None
    jobs: int | None = None

    def __post_init__(self) -> None:
        if self.address is not None:
            host_and_port(self.address)
        if self.jobs is not None:
            check_jobs(self.jobs)

    @override
    def pool(self) -> Pool:
        return _Cluster(connected(self.address, self.jobs), self.jobs)


class _Cluster(Workers):
    def __init__(self, ray: Any, jobs: int | None) -> None:
        self._ray = ray
        super().__init__(float("inf") if jobs is None else jobs)
        if not any(node["Alive"] and node["Resources"].get("CPU", 0) >= 1 for node in ray.nodes()):
            raise BackendError("no machine of the Ray cluster has a processor to offer; start one with --num-cpus")
        self._work = ray.remote(num_cpus=1, max_retries=MOST_DEATHS, scheduling_strategy="SPREAD")(_portable_work())
        self._expected = ray.put(versions())
        self._sent: dict[Any, Any] = {}

    @override
    def submit(self, key: Hashable, function: Callable[..., Any], *arguments: Any) -> None:
        pickle = self._ray.cloudpickle
        shared = [place for place, argument in enumerate(arguments) if isinstance(argument, Shared)]
        own = pickle.dumps([argument for argument in arguments if not isinstance(argument, Shared)])
        sent = [self._reference(arguments[place], arguments[place].value) for place in shared]
        task = self._work.options(name=f"forcegp {key}").remote(
            self._expected, self._reference(function, function), own, shared, *sent
        )
        self._at_work[task] = key

    @override
    def finished(self) -> list[tuple[Any, Future[Any]]]:
        ended: list[Any] = []
        while not ended:
            tasks = list(self._at_work)
            ended, _ = self._ray.wait(tasks, num_returns=1, timeout=INTERRUPTIBLE_SECONDS)
        others = [task for task in self._at_work if task not in ended]
        ended += self._ray.wait(others, num_returns=len(others), timeout=0)[0] if others else []
        return [(key, self._outcome(task, key)) for task in ended for key in [self._at_work.pop(task)]]

    @override
    def stop(self) -> None:
        for task in self._at_work:
            self._ray.cancel(task, force=True)
        if self._at_work:
            self._ray.wait(list(self._at_work), num_returns=len(self._at_work), timeout=10.0)
        self._at_work.clear()

    def _reference(self, owner: Any, value: Any) -> Any:
        """Where the cluster keeps the pickled value, as bytes: on another version these can still be received."""
        if owner not in self._sent:
            self._sent[owner] = self._ray.put(self._ray.cloudpickle.dumps(value))
        return self._sent[owner]

    def _outcome(self, task: Any, key: Hashable) -> Future[Any]:
        errors = self._ray.exceptions
        future: Future[Any] = Future()
        try:
            complaint, outcome, warned = self._ray.get(task)
        except errors.RayTaskError as error:
            future.set_exception(error.cause if isinstance(error.cause, Exception) else error)
            return future
        except errors.RayError as error:
            first = str(error).strip().partition("\n")[0]
            raise BackendError(
                f"task {key} was lost with its worker {MOST_DEATHS + 1} times, or with its cluster "
                f"({type(error).__name__}: {first}); see whether memory is short on the machines of the cluster"
            ) from None
        if complaint is not None:
            raise BackendError(complaint)
        return replayed(outcome, warned)


def versions() -> dict[str, str]:
    """What decides the numbers: Python and the packages, without the build of a package (2.13.0 of 2.13.0+cpu)."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"Python": python} | {name: metadata.version(name).partition("+")[0] for name in DECIDING}


def _portable_work() -> Callable[..., Any]:
    """What runs on a machine of the cluster. A function in a function travels whole, so it can name what is missing."""

    def work(
        expected: dict[str, str], function: bytes, own: bytes, shared: list[int], *sent: bytes
    ) -> tuple[str | None, Any, Any]:
        import pickle
        import platform
        from importlib import metadata

        found = {"Python": ".".join(platform.python_version_tuple()[:2])}
        for name in expected.keys() - found.keys():
            try:
                found[name] = metadata.version(name).partition("+")[0]
            except metadata.PackageNotFoundError:
                found[name] = "missing"
        other = [f"{name} {found[name]}, not {expected[name]}" for name in expected if found[name] != expected[name]]
        if other:
            return f"machine {platform.node()} of the Ray cluster has {'; '.join(other)}: install the same", None, None
        from forcegp.parallel.worker import recorded, use_one_thread

        use_one_thread()
        arguments = pickle.loads(own)
        for place, value in zip(shared, sent, strict=True):
            arguments.insert(place, pickle.loads(value))
        outcome, warned = recorded(pickle.loads(function), arguments)
        return None, outcome, warned

    return inspect.unwrap(work)  # what checks annotations at run time, as the tests do, cannot travel
