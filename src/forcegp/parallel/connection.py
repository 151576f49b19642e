"""The connection of this process to a Ray cluster, made once, with an answer within seconds where there is none."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from forcegp.errors import BackendError, InvalidInput, MissingExtra

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
    try:
        with warnings.catch_warnings(), _without_notices():
            warnings.filterwarnings("ignore", TIP, FutureWarning)
            _join(ray, address, jobs)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError, OSError) as error:
        where = "a cluster of this machine alone" if address is None else f"the Ray cluster at {address}"
        first = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
        raise BackendError(f"{where} cannot be used ({first}); {SAME}") from None
    return ray


@contextmanager
def _without_notices() -> Iterator[None]:
    """Without the note that Ray prints at every start of a cluster; errors are printed as ever."""
    logger = logging.getLogger("ray")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


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
