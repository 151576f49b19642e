"""Every command once on real files, some through the installed executable: exit codes, pipes.

Whatever else the commands do is tested in this process by the fixture `forcegp`, which does not import torch anew.
"""

import json
import os
import re
import subprocess
import sys

import pytest
from tests.cli.test_import import FLAGS
from tests.control import test_monitor as monitored
from tests.posterior.arm import URDF, arm_data
from tests.recordings.log_files import motion, table, write_text
from tests.scores.moving_arm import moving_arm

from forcegp.cli.main import COMMANDS

QUICK = ("--points", 8, "--iterations", 2, "--restarts", 1)

RUNS: dict[str, tuple[tuple[object, ...], str]] = {
    "simulate": (("kuka-surface", "--seconds", 0.1, "--out", "simulated.h5"), "simulated.h5"),
    "import": (("log.csv", *FLAGS, "--out", "imported.h5"), "imported.h5"),
    "robot": (("arm.urdf", "--out", "arm.html"), "arm.html"),
    "check": (("log.h5", "--out", "look"), "look/check.png"),
    "fit": (("arm.h5", *QUICK, "--out", "new"), "new/model.json"),
    "payload": (("log.h5", "--cutoff", "none", "--delay", 0, "--out", "held"), "held/payload.json"),
    "score": (
        (
            "run",
            "log.h5",
            "--forces",
            "given",
            *QUICK,
            "--seeds",
            1,
            "--horizon",
            0.05,
            "--starts",
            1,
            "--out",
            "results",
        ),
        "results/report.md",
    ),
    "view": (("run", "test.h5", "--seconds", 0.2, "--out", "seen.html"), "seen.html"),
    "monitor": (("free-run", "pushed.h5", "--free", "free.h5", "--out", "touched"), "touched/contacts.csv"),
    "excite": (
        ("run", "--seconds", 1, "--tries", 2, "--clearance", 0.001, "--avoid", "none", "--out", "next.csv"),
        "next.csv",
    ),
    "export": (("run", "--to", "c", "--out", "deployed"), "deployed/self_test.c"),
}


ELSEWHERE = {"auto": "test_auto", "demo": "test_commands"}
"""Those that take long, and where they are run."""
IN_A_PROCESS = ("fit",)


@pytest.fixture(scope="module")
def folder(forcegp, tmp_path_factory):
    """Logs of the small arm, one as CSV, and a model."""
    place = tmp_path_factory.mktemp("executable")
    for name, rows, seed in (("arm", 40, 0), ("test", 40, 1)):
        arm_data(rows, seed).save(place / f"{name}.h5")
    moving_arm(1.0, 2).save(place / "log.h5")
    write_text(place / "log.csv", table(motion()))
    (place / "arm.urdf").write_text(URDF)
    for name, seconds, seed in (("free", 55.0, 1), ("pushed", 3.0, 7)):
        monitored.saved(place / f"{name}.h5", monitored.motion(seconds, seed))
    for words in (
        ("arm.h5", "--forces", "gp:joint", "--out", "run"),
        ("free.h5", "--forces", "gp:joint-friction", "--out", "free-run"),
    ):
        assert forcegp("fit", *words, *QUICK, folder=place).returncode == 0
    return place


def test_every_command_is_run_here():
    assert {*RUNS, *ELSEWHERE} == COMMANDS.keys()


@pytest.mark.parametrize("command", RUNS)
def test_every_command_writes_its_files_and_prints_one_json_object(installed, forcegp, folder, command):
    if command == "simulate":
        pytest.importorskip("pybullet")
    words, written = RUNS[command]
    run = installed if command in IN_A_PROCESS else forcegp
    done = run(command, *words, "--json", folder=folder)
    assert done.returncode == 0, done.stderr
    assert isinstance(json.loads(done.stdout), dict)
    assert (folder / written).stat().st_size > 0


def test_a_mistake_is_one_line_on_stderr_and_exit_code_2(installed, folder):
    done = installed("fit", "missing.h5", "--out", "never", folder=folder)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("forcegp: missing.h5 is not a file")
    assert not (folder / "never").exists()


def test_people_read_the_result_on_stdout_and_warnings_on_stderr(forcegp, folder):
    done = forcegp("score", "run", "arm.h5", folder=folder)
    assert done.returncode == 0, done.stderr
    assert len(re.findall(r"^\s*(?:pan|lift|bend)\s", done.stdout, re.M)) == 3
    lines = done.stderr.splitlines()
    assert all(line.startswith("warning: ") for line in lines)
    assert any(line.startswith("warning: 8 of 40 test rows") for line in lines)


def test_version_and_help_through_the_module(installed):
    done = installed("--version")
    assert done.returncode == 0
    assert re.fullmatch(r"forcegp \d+\.\d+\.\d+\n", done.stdout)
    environment = {**os.environ, "COLUMNS": "100"}
    words = [sys.executable, "-m", "forcegp", "--help"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert all(re.search(rf"^\W*{command}\s", done.stdout, re.M) for command in COMMANDS)
