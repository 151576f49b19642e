"""Work has the same outcomes in this process, in own processes and in executors of others; nothing is left behind."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import psutil
import pytest
from tests.parallel import tasks

from forcegp.errors import BackendError, InvalidInput
from forcegp.parallel import checked_jobs, executor_for, mapped, outcome_of, submit


@pytest.fixture(scope="module")
def executors():
    with ProcessPoolExecutor(2, get_context("spawn")) as processes, ThreadPoolExecutor(2) as threads:
        yield {"processes of others": processes, "threads": threads}


@pytest.fixture(params=["this process", "own processes", "processes of others", "threads"])
def jobs(request, executors):
    return {"this process": 1, "own processes": 2, **executors}[request.param]


def test_outcomes_are_those_of_one_process_in_the_order_of_the_arguments(jobs):
    seeds, offset = [5, 3, 8, 1, 9], 3
    assert list(mapped(tasks.seeded_sum, seeds, jobs)) == [tasks.seeded_sum(seed) for seed in seeds]
    assert list(mapped(tasks.slow_first, range(3), jobs)) == [0, 1, 2]
    assert list(mapped(tasks.seeded_sum, [], jobs)) == []
    assert list(mapped(lambda number: number + offset, [1, 2], jobs)) == [4, 5]
    assert outcome_of(submit(executor_for(jobs), partial(pow, 2), 3)) == 8


def test_own_processes_work_in_the_folder_of_the_caller(tmp_path, monkeypatch):
    assert list(mapped(tasks.folder_of_work, [0, 1], 2)) == [Path.cwd()] * 2
    monkeypatch.chdir(tmp_path)
    assert list(mapped(tasks.folder_of_work, [0, 1], 2)) == [tmp_path] * 2


def test_an_exception_passes_through_in_its_place(jobs, tmp_path):
    outcomes = mapped(tasks.mark_or_fail, [tmp_path / "first", None, *(tmp_path / str(k) for k in range(20))], jobs)
    assert next(outcomes) == tmp_path / "first"
    with pytest.raises(tasks.TypedError, match="no luck") as caught:
        next(outcomes)
    assert caught.value.code == 7
    assert list(mapped(tasks.seeded_sum, [1], jobs)) == [tasks.seeded_sum(1)]


def test_outcomes_come_as_soon_as_they_are_there(jobs, tmp_path):
    """The second task waits for what the caller does with the outcome of the first."""
    outcomes = mapped(partial(tasks.wait_for_the_gate, tmp_path / "gate"), [0, 1], jobs)
    assert next(outcomes) == 0
    (tmp_path / "gate").touch()
    assert next(outcomes) == 1


def test_own_processes_are_two_and_kept_between_calls_and_compute_on_one_thread():
    first = set(mapped(tasks.process, range(8), 2))
    assert len(first) == 2
    assert os.getpid() not in first
    assert first & set(mapped(tasks.process, range(6), 2))
    counts = next(mapped(tasks.threads, [0], 2))
    assert len(counts) > 1
    assert set(counts) == {1}


def test_a_process_that_is_killed_is_an_error_and_the_next_call_has_another(tmp_path):
    with pytest.raises(BackendError, match=r"processes broke off, .*try fewer jobs"):
        list(mapped(tasks.die, [tmp_path], 2))
    assert len(list(tmp_path.iterdir())) == 1
    assert list(mapped(tasks.slow_first, [0, 1], 2)) == [0, 1]


def test_what_is_at_work_ends_with_the_caller_and_what_waits_never_begins(tmp_path):
    outcomes = mapped(tasks.sleep_long, [None, *(tmp_path / str(k) for k in range(8))], 2)
    next(outcomes)
    while len(begun := [file for file in tmp_path.iterdir() if file.read_text()]) < 2:
        time.sleep(0.01)
    outcomes.close()
    assert not any(psutil.pid_exists(int(file.read_text())) for file in begun)
    assert sorted(tmp_path.iterdir()) == sorted(begun)
    assert list(mapped(tasks.slow_first, [0, 1], 2)) == [0, 1]


def test_executors_of_others_are_told_to_cancel_and_live_on(executors, tmp_path):
    pool = executors["processes of others"]
    outcomes = mapped(partial(tasks.wait_for_the_gate, tmp_path / "gate"), range(20), pool)
    assert next(outcomes) == 0
    outcomes.close()
    (tmp_path / "gate").touch()
    assert list(mapped(tasks.seeded_sum, [1], pool)) == [tasks.seeded_sum(1)]


def test_ctrl_c_ends_the_run_and_its_processes(tmp_path):
    script = (
        "from pathlib import Path\nfrom tests.parallel import tasks\nfrom forcegp.parallel import mapped\n"
        f"list(mapped(tasks.sleep_long, [Path({str(tmp_path)!r}) / str(k) for k in range(8)], 2))\n"
    )
    (tmp_path / "script.py").write_text(script)  # without a guard of __main__, as users write it
    paths = [str(Path(__file__).resolve().parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    run = subprocess.Popen(
        [sys.executable, tmp_path / "script.py"],
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        # where the tests run in the background, their children inherit that Ctrl-C is ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    while len(begun := [file for file in tmp_path.glob("[0-9]") if file.read_text()]) < 2:
        assert run.poll() is None
        time.sleep(0.05)
    run.send_signal(signal.SIGINT)
    _, told = run.communicate(timeout=60)
    assert told.splitlines()[-1] == "KeyboardInterrupt"
    assert "Exception in thread" not in told
    assert not any(psutil.pid_exists(int(file.read_text())) for file in begun)


def test_what_cannot_travel_is_told():
    with pytest.raises(BackendError, match=r"cannot be sent to another process \(.*generator.*; use jobs=1"):
        list(mapped(tasks.seeded_sum, [(k for k in range(2))], 2))


@pytest.mark.parametrize("wrong", [0, -2, 1.5, True, "2", None, 10**20])
def test_wrong_jobs_are_told(wrong):
    with pytest.raises(InvalidInput, match=rf"jobs is {wrong!r}; give .* 1 to 1024, or an Executor"):
        checked_jobs(wrong)
