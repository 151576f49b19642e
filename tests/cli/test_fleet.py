"""Many logs with one command: rows, errors of single logs, resuming, and a cluster of which a worker is killed."""

import csv
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from forcegp.cli.fleet import Fleet, fleet, numbers_of
from forcegp.cli.main import main
from forcegp.data import Dataset
from forcegp.errors import InvalidInput
from forcegp.posterior import Estimate
from forcegp.simulation import KukaSurfaceConfig, simulate_kuka_surface

pytestmark = pytest.mark.filterwarnings("ignore::forcegp.errors.DataWarning", "ignore::forcegp.errors.DataWarning")
FIT = ("--points", "8", "--restarts", "1", "--iterations", "2", "--noise", "0.1", "--no-checks")


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> Path:
    folder, whole = tmp_path_factory.mktemp("logs"), simulate_kuka_surface(KukaSurfaceConfig(seconds=1.0, seed=1))
    for k in range(4):
        whole.rows(slice(50 * k, 50 * k + 60)).save(folder / f"robot{k}.h5")
    return folder


@pytest.fixture
def listed(logs, tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    lines = [f"{logs / f'robot{k}.h5'}{' --points 6' if k == 2 else ''}" for k in range(4)]
    (tmp_path / "list.txt").write_text("# a fleet\n\n" + "\n".join(lines))
    return tmp_path / "list.txt"


def words(out: str) -> list[str]:
    return ["fit", "--logs-from", "list.txt", "--out", out, *FIT]


def test_each_log_is_a_row_and_one_that_fails_says_so(listed, capsys):
    broken = listed.parent / "broken.h5"
    broken.write_text("no dataset")
    listed.write_text(f"{listed.read_text()}\n{broken}\n")
    assert main(words("out")) == 0
    shown = capsys.readouterr()
    assert "4 of 5 logs are done" in shown.out
    assert "not an HDF5 file" in " ".join(shown.out.split())
    with Path("out/fleet.csv").open() as file:
        rows = {row["log"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["robot0", "robot1", "robot2", "robot3", "broken"]
    header = Path("out/fleet.csv").read_text().splitlines()[0].split(",")
    assert len(set(header)) == len(header)
    assert [rows[name]["points"] for name in rows] == ["8", "8", "6", "8", ""]
    assert "not an HDF5 file" in rows["broken"]["error"]
    assert Path("out/robot1/model.json").is_file()

    # what is finished stays, what is mended is run
    written, first = Path("out/robot1/model.json").stat().st_mtime_ns, listed.read_text().split()[3]
    assert len(Dataset.load(first)) == 60
    broken.write_bytes(Path(first).read_bytes())
    assert main(words("out")) == 0
    assert "5 of 5 logs are done" in capsys.readouterr().out
    assert Path("out/robot1/model.json").stat().st_mtime_ns == written


def test_an_estimate_is_its_value_and_half_of_its_interval():
    estimate = Estimate("viscous.elbow", "Nms/rad", 0.4, 0.1, 0.0, 1.0, "log", "")
    content = {"estimates": {estimate.name: estimate.to_dict()}, "value": {"interval": 3, "value": 2}}
    content, name = {**content, "settings": {"a": 1}}, "estimates.viscous.elbow"
    each = {name: 0.4, f"{name}.error_95": pytest.approx(estimate.interval[1] - 0.4)}
    assert numbers_of(content) == {**each, "value.interval": 3, "value.value": 2}


@pytest.mark.parametrize(
    ("text", "given", "message"),
    [
        ("a.h5 --pionts 3", (), "line 1 of list.txt: forcegp fit has no option --pionts"),
        ("# none", (), "names no log"),
        ("a.h5", ("--jobs", "0"), "--jobs is 0"),
    ],
)
def test_a_wrong_list_is_refused_in_one_line(listed, capsys, text, given, message):
    listed.write_text(text)
    assert main([*words("out"), *given]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert not Path("out").exists()


def test_words_without_a_list_are_refused(listed):
    with pytest.raises(InvalidInput, match="needs --out FOLDER"):
        fleet(["fit", "--logs-from", "list.txt"])
    with pytest.raises(InvalidInput, match="needs --out FOLDER"):
        fleet(["fit", "--out", "out", "--logs-from"])
    with pytest.raises(InvalidInput, match="name no list of logs"):
        fleet(["fit", "a.h5", "--out", "out"])


@pytest.mark.usefixtures("unchecked")  # a stand-in for the runs
def test_processes_are_those_of_the_words_unless_others_are_given(listed, monkeypatch):
    monkeypatch.setattr(Fleet, "run", lambda asked, _: {"rows": [asked.jobs]})
    asked = words("out")
    assert [*fleet(asked), *fleet([*asked, "--jobs", "3"]), *fleet([*asked, "--jobs", "3"], 2)] == [1, 3, 2]


@pytest.mark.nightly  # tests/parallel has executors, and a process that is killed
def test_a_cluster_whose_worker_is_killed_gives_the_same_rows(listed):
    distributed, alone = pytest.importorskip("distributed"), fleet(words("alone"))
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster,
        distributed.Client(cluster) as client,
    ):
        pids = client.run(os.getpid)

        def kill() -> None:
            until = time.monotonic() + 60.0
            while time.monotonic() < until and not any(Path("there").glob("jobs/*/job.json")):
                time.sleep(0.02)
            os.kill(next(iter(pids.values())), signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        there = fleet(words("there"), client.get_executor())
        killer.join()
        assert set(client.run(os.getpid).values()) != set(pids.values()), "one of them was killed"
    for here, other in zip(alone, there, strict=True):
        assert here["error"] == other["error"] == ""
        same = ("points", "nll", "objective", "iterations")
        assert {name: here["numbers"][name] for name in same} == {name: other["numbers"][name] for name in same}
