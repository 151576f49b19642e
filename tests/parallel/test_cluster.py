"""The same promises on a real Ray cluster: two nodes with one processor each."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.parallel import tasks
from tests.parallel.conformance import WorkersConformance

from forcegp.errors import BackendError
from forcegp.parallel import Ray
from forcegp.parallel import cluster as cluster_module

REPOSITORY = Path(__file__).resolve().parents[2]


class TestRay(WorkersConformance):
    notice = None  # Ray itself tells it on stderr

    @pytest.fixture
    def backend(self, cluster):
        return Ray(cluster)

    def test_tasks_run_on_both_nodes(self, backend):
        assert len(set(backend.map(tasks.node, range(6)))) == 2

    def test_so_many_jobs_at_once_and_no_more(self, cluster, tmp_path):
        assert Ray(cluster, jobs=1).pool().free == 1
        assert Ray(cluster).pool().free == float("inf")

    def test_a_machine_with_other_versions_is_refused(self, backend, monkeypatch):
        expected = cluster_module.versions() | {"torch": "1.0", "forcegp": "0.0.1"}
        monkeypatch.setattr(cluster_module, "versions", lambda: expected)
        with pytest.raises(BackendError, match=r"machine .* has .*torch \d.*, not 1\.0.*: install the same"):
            list(backend.map(tasks.process, [0]))

    def test_another_cluster_needs_another_connection(self, backend, dead_address):
        assert list(backend.map(tasks.slow_first, [0])) == [0]
        with pytest.raises(BackendError, match=r"is connected to the Ray cluster at .*ray\.shutdown\(\)"):
            list(Ray(dead_address).map(tasks.slow_first, [0]))


def test_no_task_outlives_its_caller(cluster, tmp_path):
    begun = tmp_path / "begun"
    script = (
        "from forcegp.parallel import Ray\n"
        "from tests.parallel.tasks import begin_and_wait\n"
        f"list(Ray({cluster!r}).map(begin_and_wait, [{str(begun)!r}]))\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    run = subprocess.Popen([sys.executable, "-c", script], env=environment, cwd=REPOSITORY)
    wait_until(lambda: begun.exists() and begun.read_text() != "")
    run.send_signal(signal.SIGKILL)
    run.wait()
    wait_until(lambda: not alive(int(begun.read_text())))


def alive(process: int) -> bool:
    status = Path(f"/proc/{process}/status")
    return status.exists() and "State:\tZ" not in status.read_text()


def wait_until(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.05)
