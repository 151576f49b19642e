"""The same promises on a real Ray cluster: two nodes with one processor each."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from tests.jobs.test_running import TOY, next_to, square
from tests.models.arm import arm_data
from tests.parallel import tasks
from tests.parallel.conformance import WorkersConformance
from tests.parallel.two_nodes import another_node, end_session

from forcegp.errors import BackendError, FitError
from forcegp.inference import OptimizerOptions
from forcegp.jobs import Job, JobStore, run_jobs
from forcegp.models import IndependentGP, StructuredGP
from forcegp.parallel import Joblib, Ray, Serial
from forcegp.parallel import cluster as cluster_module

REPOSITORY = Path(__file__).resolve().parents[2]

pytestmark = (
    pytest.mark.nightly
)  # two nodes take 20 s to begin; test_backends.py keeps the same promises on this machine


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
        with pytest.raises(BackendError, match=r"torch \d.*, not 1\.0.*install"):
            list(backend.map(tasks.process, [0]))

    def test_another_cluster_needs_another_connection(self, backend, dead_address):
        assert list(backend.map(tasks.slow_first, [0])) == [0]
        with pytest.raises(BackendError, match=r"is connected to the Ray cluster at .*ray\.shutdown\(\)"):
            list(Ray(dead_address).map(tasks.slow_first, [0]))


@pytest.mark.parametrize("model", [StructuredGP, IndependentGP])
def test_a_fit_is_the_same_on_every_backend(cluster, model):
    """But for rounding, which other processes, whose memory is aligned otherwise, need not share."""
    train = arm_data(30, seed=0)
    how = {"points": 15, "restarts": 3, "seed": 7, "options": OptimizerOptions(iterations=4)}
    one, two, three = (
        model(train.system).fit(train, backend=backend, **how) for backend in (Serial(), Joblib(2), Ray(cluster))
    )
    assert len(set(one.settings["restart_objective"])) == 3
    for other in (two, three):
        assert other.settings["restart_objective"] == pytest.approx(one.settings["restart_objective"], rel=1e-9)
        for name, value in one.parameters.items():
            torch.testing.assert_close(other.parameters[name], value, rtol=1e-7, atol=1e-9)


def test_jobs_are_computed_without_seeing_the_folder_of_results(cluster, tmp_path):
    """Those that others are made from travel there, and all files travel back."""
    results = JobStore.open(tmp_path / "out", "a test", {})
    last = Job("last", f"{TOY}:square", {"before": "next/3"}, ("next/3",))
    assert run_jobs(results, [square(3), square(4)], Ray(cluster)) == 2
    assert run_jobs(results, [last, next_to(square(3)), square(3)], Ray(cluster)) == 2
    assert results.result("last")["value"] == 11
    assert (results.place("square/4") / "note.txt").read_text() == "beside the result"
    assert results.result("square/3")["process"] != os.getpid()
    with pytest.raises(FitError, match=r"bad failed \(no luck\); 1 of 2 jobs are kept"):
        run_jobs(results, [Job("bad", f"{TOY}:fail", {}), square(5)], Ray(cluster))


def test_a_sweep_whose_driver_is_killed_goes_on(cluster, tmp_path):
    begun = tmp_path / "begun"
    script = (
        "from pathlib import Path\n"
        "from tests.jobs.test_running import *\n"
        "from forcegp.parallel import Ray\n"
        f"slow = Job('slow', TOY + ':sleep', dict(begun={str(begun)!r}, seconds=3600))\n"
        f"store = JobStore.open(Path({str(tmp_path / 'out')!r}), 'a test', {{}})\n"
        f"run_jobs(store, [square(2), slow], Ray({cluster!r}))\n"
    )
    results = tmp_path / "out" / "jobs"
    kill_when(script, begun, lambda: (results / "square" / "2").exists())
    results = JobStore.open(tmp_path / "out", "a test", {})
    first = results.load("square/2")
    assert not results.place("slow").exists()
    assert run_jobs(results, [square(2), square(3)], Ray(cluster)) == 1
    assert results.load("square/2") == first


def test_what_a_lost_machine_was_computing_is_computed_by_the_others(cluster, tmp_path):
    backend = Ray(cluster)
    assert list(backend.map(tasks.slow_first, [0])) == [0]  # connected to a node that stays
    gates = tmp_path / "gates"
    gates.mkdir()
    with another_node(cluster, tmp_path) as node, backend.pool() as pool:
        for key in range(3):
            pool.submit(key, tasks.wait_for_the_gate, gates)
        wait_until(lambda: len(list(gates.iterdir())) == 3)
        end_session(node)
        (gates / "gate").touch()
        ended = [future.result() for _ in range(3) if len(pool) for _, future in pool.finished()]
    assert len(ended) == 3
    assert len(set(ended)) == 2


def test_no_task_outlives_its_caller(cluster, tmp_path):
    begun = tmp_path / "begun"
    script = (
        "from forcegp.parallel import Ray\n"
        "from tests.parallel.tasks import begin_and_wait\n"
        f"list(Ray({cluster!r}).map(begin_and_wait, [{str(begun)!r}]))\n"
    )
    kill_when(script, begun, lambda: True)


def kill_when(script, begun, ready):
    """Run it, SIGKILL it when its task has begun and all is ready, and wait until its task is dead, too."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    run = subprocess.Popen([sys.executable, "-c", script], env=environment, cwd=REPOSITORY)
    wait_until(lambda: begun.exists() and begun.read_text() != "" and ready())
    run.send_signal(signal.SIGKILL)
    run.wait()
    wait_until(lambda: not alive(int(begun.read_text())))


def alive(process: int) -> bool:
    status = Path(f"/proc/{process}/status")
    return status.exists() and "State:\tZ" not in status.read_text()


def wait_until(condition) -> None:
    end = time.monotonic() + 600.0  # a guard against a hang
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.05)
