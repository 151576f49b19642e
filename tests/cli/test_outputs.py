"""Where commands write: never over what is not theirs, never over what they read, and tried before the work."""

import json
import math
import os
import stat
import sys
from pathlib import Path

import pytest
from tests.posterior.arm import URDF, arm_data

import forcegp
import forcegp.scores
from forcegp import Dataset
from forcegp.atomic_files import MARK, write_digests
from forcegp.cli.main import main, parse_arguments

QUICK = "--points 8 --iterations 2 --restarts 1 --no-checks"
IMPORT = "import log.csv --time time --q q_a,q_a,q_a --u u_a,u_a,u_a --robot arm.urdf"
FILES = {
    "simulate": "simulate kuka-surface --overwrite --out OUT",
    "import": f"{IMPORT} --overwrite --out OUT",
    "prepare": "import arm.h5 --every 2 --overwrite --out OUT",
}
FOLDERS = {
    "fit": "fit arm.h5 --overwrite --out OUT",
    "export": "export run --to c --overwrite --out OUT",
    "demo": "demo --overwrite --out OUT",
}
STORES = {"score": "score arm.h5 --split blocks:5:3 --guard 0 --horizon 0.02 --points 9 --overwrite --out OUT"}
COMMANDS = FILES | FOLDERS | STORES


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A folder with data, a log and what passes for a model as long as nothing reads it; the current one."""
    monkeypatch.chdir(tmp_path)
    arm_data(40, seed=0).save("arm.h5")
    rows = (f"{k / 100},{math.sin(k / 30)},{math.cos(k / 50)}" for k in range(300))
    Path("log.csv").write_text("time,q_a,u_a\n" + "\n".join(rows) + "\n")
    Path("arm.urdf").write_text(URDF)
    Path("run").mkdir()
    return tmp_path


@pytest.fixture
def no_work(monkeypatch, request) -> None:
    """Whoever begins the work of the command `name` fails."""
    name = request.node.callspec.params["name"] if hasattr(request.node, "callspec") else ""
    monkeypatch.setattr(sys, "argv", [name])

    def begun(*_, **__):
        raise AssertionError("the work has begun")

    monkeypatch.setattr("forcegp.jobs._compute_all", begun)
    monkeypatch.setattr("forcegp.recordings.importing._sources", begun)
    monkeypatch.setattr("forcegp.cli.simulated.simulate_with_progress", begun)
    monkeypatch.setattr("forcegp.scores.learn", begun)
    own = Dataset.load
    monkeypatch.setattr(Dataset, "load", lambda path: own(path) if "score" in sys.argv else begun())


def filled(name: str, out: object) -> list[str]:
    return [str(out) if word == "OUT" else word for word in COMMANDS[name].split()]


def hidden(folder: Path) -> list[Path]:
    return [entry for entry in folder.rglob(".*") if entry.name != ".lock"]


def refused(words: list[str], capfd) -> str:
    capfd.readouterr()
    assert main(words) == 2, capfd.readouterr().err
    told = capfd.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1, told.err
    return told.err


@pytest.mark.parametrize("name", COMMANDS)
def test_what_cannot_be_written_is_noticed_before_the_work_and_pipes_stay(folder, no_work, capfd, name):
    os.mkfifo("pipe")
    Path("link").symlink_to("pipe")
    for out in ("pipe", "link", "arm.urdf/out", *["/proc/forcegp-out"] * Path("/proc/self").exists()):
        refused(filled(name, out), capfd)
        assert stat.S_ISFIFO(Path("pipe").stat().st_mode)
        assert Path("link").is_symlink()
    assert Path("arm.urdf").read_text() == URDF
    assert not hidden(folder)


@pytest.mark.parametrize("name", COMMANDS)
def test_two_commands_do_not_write_to_one_place(folder, no_work, capfd, name):
    Path("link").symlink_to("new")
    with parse_arguments(filled(name, "link")).alone():
        assert "another command of forcegp is writing" in refused(filled(name, "new"), capfd)
        with parse_arguments(filled(name, "elsewhere")).alone():
            pass
    with parse_arguments(filled(name, "new")).alone():
        pass
    assert not hidden(folder)


def test_locks_of_another_user_are_not_used(folder, no_work, monkeypatch, capfd):
    mine = os.getuid()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    monkeypatch.setattr(os, "getuid", lambda: mine + 1)
    assert "belongs to another user; set TMPDIR" in refused(filled("fit", "new"), capfd)
    monkeypatch.setattr(os, "getuid", lambda: mine + 2)
    Path(f"forcegp-locks-{mine + 2}").symlink_to("nowhere")
    assert "where a folder is needed: a file, or a link to nothing" in refused(filled("fit", "new"), capfd)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_full_disk_is_noticed_before_the_work(folder, no_work, capfd, limited_file_size, name):
    with limited_file_size(2000):
        told = refused(filled(name, "out"), capfd)
    assert "File too large" in told
    assert not hidden(folder)


@pytest.mark.parametrize("name", FOLDERS)
def test_files_that_a_user_put_there_are_never_deleted(folder, no_work, capfd, name):
    Path("out").mkdir()
    kind = f"forcegp {name}"
    Path("out/config.json").write_text(json.dumps({"kind": kind}))
    write_digests(Path("out"))
    Path("out/notes.txt").write_text("mine")
    told = refused(filled(name, "out"), capfd)
    assert f"out holds files that `{kind}` did not write (notes.txt), so it is not overwritten" in told
    assert Path("out/notes.txt").read_text() == "mine"


@pytest.mark.parametrize("written", ["a file", "a robot", "a motion", "a folder"])
def test_what_another_process_wrote_meanwhile_stays(folder, capfd, monkeypatch, written):
    def meanwhile(own, make):
        return lambda *given, **more: (make(), own(*given, **more))[1]

    works = {"a file": (forcegp, "import_recordings"), "a motion": (forcegp, "excitation")}
    works["a robot"] = (forcegp.Model, "from_file")
    words = {"a robot": "robot arm.urdf --out out.xml", "a motion": "excite --robot arm.urdf --tries 3 --out out"}
    if written != "a folder":
        out = words.get(written, "out").split()[-1]
        change = meanwhile(getattr(*works[written]), lambda: Path(out).write_text("theirs"))
        monkeypatch.setattr(*works[written], change)
        told = refused(words.get(written, f"{IMPORT} --out out").split(), capfd).replace(".xml", "")
        Path(out).rename("out")
        assert Path("out").read_text() == "theirs"
    else:
        change = meanwhile(
            forcegp.scores.learn, lambda: (Path("out").mkdir(exist_ok=True), Path("out/a").write_text("theirs"))
        )
        monkeypatch.setattr("forcegp.scores.learn", change)
        told = refused(["fit", "arm.h5", *QUICK.split(), "--out", "out"], capfd)
        assert Path("out/a").read_text() == "theirs"
    assert "out exists" in told
    assert not hidden(folder)


OVER_INPUTS = [
    "import log.csv --time time --q q_a,q_a,q_a --u u_a,u_a,u_a --robot arm.urdf --out log.csv",
    "import log.csv --time time --q q_a,q_a,q_a --u u_a,u_a,u_a --robot arm.urdf --out ./run/../log.csv",
    "import log.csv --time time --q q_a,q_a,q_a --u u_a,u_a,u_a --robot arm.urdf --out link.csv",
    "import log.csv --time time --q q_a,q_a,q_a --u u_a,u_a,u_a --robot arm.urdf --out hard.csv",
    "import log.csv --time time --q q_a --u u_a --robot arm.urdf --out arm.urdf",
    "import arm.h5 --every 2 --out arm.h5", "fit arm.h5 --robot arm.urdf --out arm.urdf",
    "fit arm.h5 --identified run --out run", "fit run/inner.h5 --out run",
    "fit arm.h5 --robot run/inner.urdf --forces bodies --out run",
    "payload arm.h5 --baseline run/inner.h5 --out run", "score run arm.h5 --out run", "score arm.h5 --out arm.h5",
]  # fmt: skip


@pytest.mark.parametrize("words", OVER_INPUTS)
def test_no_command_writes_over_what_it_reads(folder, capfd, words):
    Path("link.csv").symlink_to("log.csv")
    os.link("log.csv", "hard.csv")
    for name in ("inner.h5", "inner.urdf"):
        os.link("arm." + name.partition(".")[2], f"run/{name}")
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    overwrite = [] if words.startswith("score arm") else ["--overwrite"]
    assert "this command" in refused([*words.split(), *overwrite], capfd)
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == before


@pytest.mark.parametrize("name", ["thesis.txt", "arm.urdf", "log.csv"])
def test_overwriting_is_for_files_of_the_same_kind(folder, capfd, name):
    Path("thesis.txt").write_text("years of work")
    before = Path(name).read_bytes()
    for words in (FILES["simulate"], FILES["prepare"]):
        told = refused([name if word == "OUT" else word for word in words.split()], capfd)
        assert f"{name} is not a dataset of forcegp, so it is not overwritten" in told
    assert Path(name).read_bytes() == before


ALIKE = {
    "robot arm.urdf --out mine.xml": '<mujoco model="mine"><worldbody/></mujoco>',
    "robot arm.urdf --out mine.urdf": URDF,
    "view arm.h5 --out mine.html": f"<html>{MARK}, a novel{' ' * 300}</html>",
    "excite --robot arm.urdf --out mine.csv": "t,q_a,v_a,a_a,u_a\n0,0,0,0,0\n0.01,0,1,2,3\n0.02,0.1,0,0,0\n",
}


@pytest.mark.parametrize("words", ALIKE)
def test_only_what_forcegp_wrote_is_replaced(folder, capfd, words):
    (mine := Path(words.split()[-1])).write_text(ALIKE[words])
    assert "of forcegp, so it is not overwritten" in refused([*words.split(), "--overwrite"], capfd)
    assert mine.read_text() == ALIKE[words]
    if words.startswith("robot"):
        mine.unlink()
        assert [main([*words.split(), *more]) for more in ((), (), ("--overwrite",))] == [0, 2, 0]


def test_a_changed_model_of_an_identification_is_refused(folder, capfd):
    Path("found").mkdir()
    model = arm_data(5, seed=0).model.to_json()
    Path("found/system.json").write_text(model)
    write_digests(Path("found"))
    assert main(["fit", "arm.h5", *QUICK.split(), "--identified", "found", "--out", "one"]) == 0
    Path("found/system.json").write_text(model.replace("0.6", "0.7"))
    told = refused(["fit", "arm.h5", "--identified", "found", "--out", "two"], capfd)
    assert "found is damaged: system.json is not as it was written; fit again" in told


@pytest.mark.skipif(sys.platform == "darwin", reason="names are UTF-8 there")
def test_names_that_are_no_text_are_refused(folder, capfd):
    name = os.fsdecode(b"arm\xff.h5")
    os.link("arm.h5", name)
    for words in (["check", name], ["fit", "arm.h5", "--out", name], ["fit", "arm.h5", "--out", "x\0y"]):
        assert "holds NUL or is not UTF-8; give another, or rename it" in refused(words, capfd)
