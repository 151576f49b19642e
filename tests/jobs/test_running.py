"""Jobs run in order, several at once, each once; failures and kills cost only what was not finished."""

import os
from pathlib import Path

import pytest

from forcegp.errors import BackendError, DataWarning, FitError
from forcegp.jobs import Job, JobStore, digests, run_jobs
from forcegp.progress import watched

TOY = "tests.jobs.toy_tasks"


def square(number: int) -> Job:
    return Job(f"square/{number}", f"{TOY}:square", {"number": number})


def next_to(job: Job) -> Job:
    return Job(f"next/{job.name.rpartition('/')[2]}", f"{TOY}:square", {"before": job.name}, (job.name,))


@pytest.fixture
def results(tmp_path):
    return JobStore.open(tmp_path / "out", "a test", {})


def test_all_jobs_are_computed_once_and_in_order(results):
    jobs, told = [next_to(square(3)), square(3), square(4)], []
    with watched(lambda *given: told.append(given)):
        assert run_jobs(results, jobs, at_once=2) == 3
    assert results.result("next/3")["value"] == 10
    assert results.result("square/4")["value"] == 16
    assert (results.place("square/4") / "note.txt").read_text() == "beside the result"
    assert results.result("square/3")["process"] != os.getpid()
    assert ([done for done, *_ in told], told[-1][0]) == (sorted((done for done, *_ in told)), told[-1][1])
    before = results.load("square/3")
    assert run_jobs(results, [*jobs, square(5)]) == 1
    assert results.load("square/3") == before


def test_a_relative_folder_is_that_of_the_caller_not_of_the_processes(results, tmp_path, monkeypatch):
    run_jobs(results, [square(3), square(4)], at_once=2)  # processes begin in the folder of now
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    run_jobs(JobStore.open(Path("kept"), "a test", {}), [square(5), square(6)], at_once=2)
    assert (tmp_path / "elsewhere" / "kept" / "jobs" / "square" / "5" / "note.txt").exists()


def test_a_failure_stops_only_what_needs_it(results):
    bad = Job("bad", f"{TOY}:fail", {})
    jobs = [bad, next_to(bad), Job("after", f"{TOY}:square", {"before": "next/bad"}, ("next/bad",)), square(2)]
    with pytest.raises(FitError, match=r"bad failed.*no luck.*1 of \d jobs are kept"):
        run_jobs(results, jobs)
    assert results.result("square/2")["value"] == 4
    assert not results.place("bad").exists()


@pytest.mark.parametrize(("task", "cause"), [("break_down", "ZeroDivisionError"), ("not_a_number", "ValueError")])
def test_a_defect_in_one_job_does_not_cost_the_others(results, task, cause):
    with pytest.raises(FitError, match=rf"bad failed \({cause}: .*1 of 2 jobs are kept"):
        run_jobs(results, [Job("bad", f"{TOY}:{task}", {}), square(2)], 2)
    assert results.result("square/2")["value"] == 4
    assert not results.place("bad").exists()


def test_on_a_full_disk_nothing_more_is_begun(results):
    with pytest.raises(FitError, match=r"full failed, 2 .* left out \(.*No space left on device\); 0 of 3 jobs"):
        run_jobs(results, [Job("full", f"{TOY}:fill_the_disk", {}), square(2), square(3)])
    assert run_jobs(results, [square(2), square(3)]) == 2


def test_a_process_that_dies_is_reported_and_what_was_done_is_kept(results, tmp_path):
    dead = Job("dead", f"{TOY}:die_once", {"marker": str(tmp_path / "marker")}, ("square/2",))
    with pytest.raises(BackendError, match=r"processes broke off.*1 of 2 jobs are kept, so the same command goes on"):
        run_jobs(results, [square(2), dead], 2)
    assert results.result("square/2")["value"] == 4
    assert run_jobs(results, [square(2), dead]) == 1
    assert results.result("dead") == {"survived": True}
    assert not list((tmp_path / "out").glob("**/*.tmp"))


def test_other_settings_of_an_input_are_seen_and_computed_anew_with_one_sentence(results):
    run_jobs(results, [square(3), next_to(square(3)), square(4)])
    kept, changed = results.load("square/4"), Job("square/3", f"{TOY}:square", {"number": 3, "more": 1})
    assert digests([changed, next_to(square(3))])["next/3"] != digests([square(3), next_to(square(3))])["next/3"]
    with pytest.warns(DataWarning, match="2 of the results in .* for example, were computed by other code or with"):
        assert run_jobs(results, [changed, next_to(changed), square(4)]) == 2
    assert results.load("square/3")["spec"] == {"number": 3, "more": 1}
    assert results.load("square/4") == kept
    assert run_jobs(results, [changed, next_to(changed)]) == 0


def test_other_code_is_seen_and_computed_anew_with_one_sentence(results, monkeypatch):
    run_jobs(results, [square(3), next_to(square(3))])
    monkeypatch.setattr("forcegp.jobs.code_digest", lambda *modules: "other")
    with pytest.warns(DataWarning, match="2 of the results in .*they are computed anew"):
        assert run_jobs(results, [square(3), next_to(square(3))]) == 2
    assert results.load("square/3")["code"] == "other"


def test_arguments_reach_the_task_wherever_it_runs(results):
    shared = {"factor": 3}
    for number, at_once in enumerate((1, 2)):
        job = Job(f"times/{number}", f"{TOY}:times", {"number": 5}, arguments=(shared, 2))
        after = Job(f"after/{number}", f"{TOY}:square", {"before": job.name}, (job.name,))
        assert run_jobs(results, [after, job], at_once) == 2
        assert results.result(job.name)["value"] == 5 * 3 * 2
        assert results.result(after.name)["value"] == 31
