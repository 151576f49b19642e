"""`Ray`: the machines of a Ray cluster."""

import inspect
import logging
import os
import platform
import socket
import subprocess
import sys
import warnings
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from dataclasses import dataclass
from importlib import metadata
from typing import Any, ClassVar

from typing_extensions import override

from forcegp.errors import BackendError, InvalidInput, MissingExtra
from forcegp.parallel.backend import MOST_DEATHS, Backend, Joblib, Pool, Serial, Shared, check_jobs, replayed

ANSWER_SECONDS = 10
"""So long a machine is given to answer."""

JOIN_SECONDS = 20
"""So long its cluster is given then."""

JOIN = """
import sys, ray
try:
    ray.init(address=sys.argv[1], configure_logging=False, log_to_driver=False)
except Exception as error:
    print(type(error).__name__, *str(error).split()[:60])
    sys.exit(1)
"""
"""A trial in a process of its own: where there is no cluster, Ray asks for minutes and then ends the process."""

SAME = (
    "this machine must be one of its nodes (ray start --address=...), with the same versions of Ray and Python and the "
    "same RAY_AUTH_MODE"
)

TIP = "(?s).*Tip: In future versions of Ray"
"""How a warning begins that Ray gives at every start, about accelerators, which are not used here."""


def connected(address: str | None, jobs: int | None) -> Any:
    """The module `ray`, connected to the cluster at `address`.

    None is the cluster that this process is connected to already, that of RAY_ADDRESS, that which was started on this
    machine last, or else a new one of this machine alone with `jobs` processors (None: all), which ends with this
    process.

    Raises MissingExtra without Ray, InvalidInput for no address, BackendError where no cluster answers.
    """
    try:
        import ray
    except ImportError:
        raise MissingExtra("backend ray needs Ray: pip install 'forcegp[scale]'") from None
    if address is not None:
        host_and_port(address)
    if ray.is_initialized():
        _require_same(ray.get_runtime_context().gcs_address, address)
        return ray
    address = address or os.environ.get("RAY_ADDRESS") or None
    if address is not None:
        _require_alive(address)
    logger = logging.getLogger("ray")
    level = logger.level
    logger.setLevel(logging.ERROR)  # without the note that Ray prints at every start of a cluster
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", TIP, FutureWarning)
            _join(ray, address, jobs)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError, OSError) as error:
        where = "a cluster of this machine alone" if address is None else f"the Ray cluster at {address}"
        first = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise BackendError(f"{where} cannot be used ({first}); {SAME}") from None
    finally:
        logger.setLevel(level)
    return ray


def host_and_port(address: str) -> tuple[str, int]:
    """The parts of HOST:PORT. Raises InvalidInput for anything else."""
    host, _, port = address.rpartition(":")
    if "/" in address or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InvalidInput(
            f"the address of the Ray cluster is {address!r}; give HOST:PORT of its head as `ray start --head` prints "
            "it, for example 10.0.0.1:6379"
        )
    return host.strip("[]"), int(port)


def _join(ray: Any, address: str | None, jobs: int | None) -> None:
    """Connect to that cluster, to the one that runs on this machine, or to a new one."""
    quietly = {"configure_logging": False, "log_to_driver": False}
    try:
        ray.init(address=address or "auto", **quietly)
    except ConnectionError:
        if address is not None:
            raise
        ray.init(address="local", num_cpus=jobs, include_dashboard=False, **quietly)


def _require_same(connected_to: str, address: str | None) -> None:
    if address is None:
        return
    (host, port), (other, other_port) = host_and_port(address), host_and_port(connected_to)
    if port == other_port and (host == other or _is_here(host) == _is_here(other) is True):
        return
    raise BackendError(
        f"this process is connected to the Ray cluster at {connected_to}; call ray.shutdown() before it uses {address}"
    )


def _is_here(host: str) -> bool:
    """Whether a name or number of a machine is one of this machine: only then can a socket be bound to it."""
    try:
        with socket.create_server((host, 0)):
            return True
    except OSError:
        return False


def _require_alive(address: str) -> None:
    """Raises BackendError unless a Ray cluster answers in time."""
    host, port = host_and_port(address)
    remedy = (
        f"start it with `ray start --head --port={port}` on {host}, or give the address of one that runs (`ray status` "
        "there prints)"
    )
    try:
        socket.create_connection((host, port), timeout=ANSWER_SECONDS).close()
    except OSError as error:
        raise BackendError(f"no Ray cluster answers at {address} ({error.strerror or error}); {remedy}") from None
    asked = [sys.executable, "-c", JOIN, address]
    try:
        found = subprocess.run(asked, capture_output=True, text=True, timeout=JOIN_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        raise BackendError(f"what answers at {address} is no Ray cluster, or one too busy; {remedy}") from None
    if found.returncode != 0:
        lines = found.stdout.strip().splitlines() or ["the connection was lost"]
        raise BackendError(f"the Ray cluster at {address} cannot be used ({lines[-1]}); {SAME}")


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


class _Cluster(Pool):
    def __init__(self, ray: Any, jobs: int | None) -> None:
        super().__init__(float("inf") if jobs is None else jobs)
        self._ray = ray
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
        from forcegp.parallel.backend import recorded, use_one_thread

        use_one_thread()
        arguments = pickle.loads(own)
        for place, value in zip(shared, sent, strict=True):
            arguments.insert(place, pickle.loads(value))
        outcome, warned = recorded(pickle.loads(function), arguments)
        return None, outcome, warned

    return inspect.unwrap(work)  # what checks annotations at run time, as the tests do, cannot travel


BACKENDS: dict[str, type[Backend]] = {kind.name: kind for kind in (Serial, Joblib, Ray)}


def backend_of(name: str, jobs: int | None = None, address: str | None = None) -> Backend:
    """The backend of this name: serial, joblib or ray.

    jobs: tasks at once; None is as many as this machine has cores, or as the cluster can take. address: of a Ray
    cluster, HOST:PORT. Raises InvalidInput for another name, and for arguments that mean nothing to it.
    """
    if name not in BACKENDS:
        raise InvalidInput(f"there is no backend {name!r}; choose {', '.join(BACKENDS)}")
    if jobs is not None:
        check_jobs(jobs)
    if address is not None and name != Ray.name:
        raise InvalidInput(f"the address {address} is that of a cluster, and backend {name} uses none; choose ray")
    if name == Ray.name:
        return Ray(address, jobs)
    if name == Joblib.name:
        return Joblib(os.cpu_count() or 1 if jobs is None else jobs)
    if jobs not in (None, 1):
        raise InvalidInput(f"backend serial does one task at a time, not {jobs}; choose joblib, or leave jobs out")
    return Serial()


def backend_for(given: Backend | str | None, jobs: int | None = None) -> Backend:
    """What a function means that takes both: a backend, its name, or None for processes as soon as jobs is above 1.

    Raises InvalidInput as `backend_of`, and for a backend with jobs of its own together with others.
    """
    if given is None:
        given = Serial.name if jobs in (None, 1) else Joblib.name
    if isinstance(given, str):
        return backend_of(given, jobs)
    if not isinstance(given, Backend):
        raise InvalidInput(
            f"backend is a {type(given).__name__}; give Serial(), Joblib(jobs), Ray(address), or one of the names "
            f"{', '.join(BACKENDS)}"
        )
    if jobs is not None and jobs != getattr(given, "jobs", 1):
        raise InvalidInput(f"jobs={jobs} contradicts backend={given}; give one of them")
    return given
