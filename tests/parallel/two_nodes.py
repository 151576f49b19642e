"""A Ray cluster of two nodes on this machine, in sessions of their own, all of whose processes are ended."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SMALL = ("--num-cpus=1", "--object-store-memory=80000000", "--disable-usage-stats", "--block")


@contextmanager
def two_nodes() -> Iterator[str]:
    """HOST:PORT of the head."""
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # short: sockets lie deep in it, and their names are bounded
    address = f"127.0.0.1:{_free_port()}"
    nodes: list[subprocess.Popen[bytes]] = []
    try:
        port = address.rpartition(":")[2]
        nodes.append(
            _start(folder, "head", "--head", f"--port={port}", f"--temp-dir={folder}", "--include-dashboard=false")
        )
        _wait_for(address, folder, 1, nodes)
        nodes.append(_start(folder, "other", f"--address={address}"))
        _wait_for(address, folder, 2, nodes)
        yield address
    finally:
        for node in nodes:
            end_session(node)
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def another_node(address: str, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """One more node, once it has joined; its log is written to that folder."""
    node = _start(str(folder), "another", f"--address={address}")
    try:
        _wait_for(address, str(folder), 3, [node])
        yield node
    finally:
        end_session(node)


def _start(folder: str, name: str, *words: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--node-ip-address=127.0.0.1", *SMALL, *words]
    with (Path(folder) / f"{name}.log").open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True, cwd=folder)


def _wait_for(address: str, folder: str, count: int, nodes: list[subprocess.Popen[bytes]]) -> None:
    """Until so many nodes have joined."""
    asked = (
        "import sys, ray\n"
        f"ray.init(address={address!r}, log_to_driver=False, configure_logging=False)\n"
        f"sys.exit(0 if sum(node['Alive'] for node in ray.nodes()) == {count} else 3)"
    )
    end = time.monotonic() + 600.0  # a guard against a hang
    while True:
        if _listens(address) and subprocess.run([sys.executable, "-c", asked], capture_output=True).returncode == 0:
            return
        logs = "\n".join(log.read_text() for log in Path(folder).glob("*.log"))
        assert all(node.poll() is None for node in nodes), f"a node of the cluster ended:\n{logs}"
        assert time.monotonic() < end, f"the cluster did not start within ten minutes:\n{logs}"
        time.sleep(0.3)


def _listens(address: str) -> bool:
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=1.0).close()
    except OSError:
        return False
    return True


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def end_session(node: subprocess.Popen[bytes]) -> None:
    """End the node and everything that it started: all that is in the session that was made for it."""
    end = time.monotonic() + 600.0  # a guard against a hang
    while members := session(node.pid):
        assert time.monotonic() < end, f"processes {members} cannot be ended"
        for member in members:
            try:
                os.kill(member, signal.SIGKILL)
            except ProcessLookupError:
                continue
        node.poll()
        time.sleep(0.05)
    node.wait()


def session(leader: int) -> list[int]:
    """Processes, zombies not counted, in the session of this leader."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, of = status.read_text().rpartition(")")[2].split()[:4]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(of) == leader and state != "Z":
            found.append(int(status.parent.name))
    return found
