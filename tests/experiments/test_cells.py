"""Cells run in order, several at once, each once; failures and kills cost only what was not finished."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from forcegp.errors import BackendError, FileFormatError, FitError, WorkerWarning
from forcegp.experiments.cells import Cell, digests, run_cells
from forcegp.experiments.results import Results
from forcegp.parallel import Joblib, Serial

TOY = "tests.experiments.toy_tasks"


def square(number: int) -> Cell:
    return Cell(f"square/{number}", f"{TOY}:square", {"number": number})


def next_to(cell: Cell) -> Cell:
    return Cell(f"next/{cell.name.rpartition('/')[2]}", f"{TOY}:square", {"before": cell.name}, (cell.name,))


@pytest.fixture
def results(tmp_path):
    return Results.open(tmp_path / "out", "smoke")


def test_all_cells_are_computed_once_and_in_order(results):
    cells = [next_to(square(3)), square(3), square(4)]
    told = []
    assert run_cells(results, cells, backend=Joblib(2), progress=lambda *given: told.append(given)) == 3
    assert results.result("next/3")["value"] == 10
    assert results.result("square/4")["value"] == 16
    assert (results.cell_folder("square/4") / "note.txt").read_text() == "beside the result"
    assert results.result("square/3")["process"] != os.getpid()
    assert [done for done, *_ in told] == sorted(done for done, *_ in told)
    assert told[-1][0] == told[-1][1]
    before = results.load("square/3")
    assert run_cells(results, [*cells, square(5)]) == 1
    assert results.load("square/3") == before


def test_a_failure_stops_only_what_needs_it(results):
    bad = Cell("bad", f"{TOY}:fail", {})
    cells = [bad, next_to(bad), next_to(next_to(bad)), square(2)]
    with pytest.raises(FitError, match=r"bad failed.*no luck.*1 of \d cells are kept"):
        run_cells(results, cells)
    assert results.result("square/2")["value"] == 4
    assert not results.cell_folder("bad").exists()


@pytest.mark.parametrize(("task", "cause"), [("break_down", "ZeroDivisionError"), ("not_a_number", "ValueError")])
def test_a_defect_in_one_cell_does_not_cost_the_others(results, task, cause):
    with pytest.raises(FitError, match=rf"bad failed \({cause}: .*1 of 2 cells are kept"):
        run_cells(results, [Cell("bad", f"{TOY}:{task}", {}), square(2)], backend=Joblib(2))
    assert results.result("square/2")["value"] == 4
    assert not results.cell_folder("bad").exists()


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore:a process died while:forcegp.errors.WorkerWarning")
def test_a_process_that_always_dies_is_reported_and_what_was_done_is_kept(results):
    with pytest.raises(BackendError, match=r"died 4 times while task dead .*1 of 2 cells are kept"):
        run_cells(results, [square(2), Cell("dead", f"{TOY}:die", {}, ("square/2",))])
    assert results.result("square/2")["value"] == 4


def test_a_process_that_is_killed_is_replaced(results, tmp_path):
    cell = Cell("killed", f"{TOY}:die_once", {"marker": str(tmp_path / "marker")})
    with pytest.warns(WorkerWarning, match="task killed"):
        assert run_cells(results, [cell, square(2)]) == 2
    assert results.result("killed") == {"survived": True}
    assert not list((tmp_path / "out").glob("**/*.tmp"))


def test_this_process_can_do_it_all(results):
    assert run_cells(results, [next_to(square(3)), square(3)], Serial()) == 2
    assert results.result("next/3")["value"] == 10
    assert results.result("square/3")["process"] == os.getpid()


def test_other_settings_of_what_a_cell_is_made_from_are_seen(results):
    run_cells(results, [square(3), next_to(square(3))])
    changed = Cell("square/3", f"{TOY}:square", {"number": 3, "more": 1})
    assert digests([changed, next_to(square(3))])["next/3"] != digests([square(3), next_to(square(3))])["next/3"]
    shutil.rmtree(results.cell_folder("square/3"))
    with pytest.raises(FileFormatError, match=r"next/3/cell\.json .*other settings"):
        run_cells(results, [changed, next_to(changed)])


def test_warnings_are_kept_with_the_cell(results):
    run_cells(results, [Cell("w", f"{TOY}:warn", {})])
    assert results.load("w")["warnings"] == ["look here"]


@pytest.mark.nightly
def test_kill_9_loses_only_the_cell_at_work_and_leaves_no_process(tmp_path):
    begun = tmp_path / "begun"
    script = (
        "from pathlib import Path\n"
        "from tests.experiments.test_cells import *\n"
        "if __name__ == '__main__':\n"
        f"    slow = Cell('slow', TOY + ':sleep', dict(begun={str(begun)!r}, seconds=3600))\n"
        f"    run_cells(Results.open(Path({str(tmp_path / 'out')!r}), 'smoke'), [square(2), slow])\n"
    )
    (tmp_path / "script.py").write_text(script)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    run = subprocess.Popen([sys.executable, tmp_path / "script.py"], env=environment)
    _wait_until(lambda: begun.exists() and begun.read_text() != "")
    run.send_signal(signal.SIGKILL)
    run.wait()
    worker = int(begun.read_text())
    _wait_until(lambda: not _alive(worker))
    results = Results.open(tmp_path / "out", "smoke")
    first = results.load("square/2")
    assert not results.cell_folder("slow").exists()
    assert run_cells(results, [square(2), square(3)]) == 1
    assert results.load("square/2") == first
    assert not list((tmp_path / "out").glob("**/*.tmp"))


def _alive(process: int) -> bool:
    status = Path(f"/proc/{process}/status")
    return status.exists() and "State:\tZ" not in status.read_text()


def _wait_until(condition) -> None:
    end = time.monotonic() + 600.0  # a guard against a hang
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.05)
