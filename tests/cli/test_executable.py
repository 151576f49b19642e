"""What belongs to a process: the installed executable, its exit codes and pipes; and commands that have no file here.

Whatever else the commands do is tested in this process by the fixture `forcegp`, which does not import torch anew.
"""

import json
import os
import re
import subprocess
import sys

import pytest
from tests.posterior.arm import URDF, arm_data

from forcegp.cli.arguments import COMMANDS


@pytest.fixture
def folder(tmp_path):
    arm_data(40, 0).save(tmp_path / "arm.h5")
    (tmp_path / "arm.urdf").write_text(URDF)
    return tmp_path


@pytest.mark.nightly
def test_a_fit_prints_one_json_object(installed, folder):
    few = ("--points", 8, "--iterations", 2, "--restarts", 1)
    done = installed("fit", "arm.h5", *few, "--out", "new", "--json", folder=folder)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["points"] == 8
    assert (folder / "new" / "model.json").stat().st_size > 0


def test_a_recording_becomes_a_page_in_the_browser(forcegp, folder, monkeypatch):
    pytest.importorskip("viser")
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    for words in (("--out", "seen.html"), ()):
        done = forcegp("view", "arm.h5", "--seconds", 0.2, *words, "--json", folder=folder).ok()
        assert "<iframe" in (folder / json.loads(done.stdout)["html"]).read_text()
    assert len(opened) == 1
    assert opened[0].startswith("file:///")


def test_version_and_help_through_the_module(installed):
    done = installed("--version")
    assert done.returncode == 0
    assert re.fullmatch(r"forcegp \d+\.\d+\.\d+\n", done.stdout)
    environment, words = {**os.environ, "COLUMNS": "100"}, [sys.executable, "-m", "forcegp", "--help"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert all(re.search(rf"^\W*{command}\s", done.stdout, re.M) for command in COMMANDS)
    environment["PYTHONIOENCODING"] = "ascii"  # which lacks the letters of units
    done = subprocess.run([*words[:3], "score", "--help"], env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr, "kg m?" in done.stdout) == (0, "", True)


@pytest.mark.parametrize("closed", [">&-", ">&- 2>&- <&-"])
@pytest.mark.nightly
def test_a_stream_that_is_closed_is_no_error(executable, folder, closed):
    words = ["sh", "-c", f"{executable} robot arm.urdf {closed}"]
    done = subprocess.run(words, cwd=folder, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.nightly
def test_a_reader_that_has_seen_enough_is_no_error(executable, folder):
    words = [executable, "robot", "arm.urdf"]
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        running.stdout.close()
        assert (running.wait(), running.stderr.read()) == (0, b"")


def test_an_environment_that_libraries_do_not_take_is_one_sentence(tmp_path):
    words = [sys.executable, "-m", "forcegp", "robot", "no.urdf"]
    how = {"cwd": tmp_path, "capture_output": True, "text": True, "check": False}
    done = subprocess.run(words, env={**os.environ, "SOURCE_DATE_EPOCH": "x"}, **how)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "forcegp: SOURCE_DATE_EPOCH is 'x'; give whole seconds, or unset it.\n"
    code = [sys.executable, "-c", "from forcegp.cli.main import main; main(); import matplotlib", "--version"]
    done = subprocess.run(code, env={**os.environ, "MPLBACKEND": "nonsense"}, **how)
    assert (done.returncode, done.stderr) == (0, "")
    stops = "{'__getattr__': lambda *_: signal.raise_signal(signal.SIGINT)}"
    heard = "signal.signal(signal.SIGINT, signal.default_int_handler)"  # which jobs in the background do not
    code[2] = f"import signal, sys; {heard}; sys.modules['tyro'] = type('', (), {stops})(); {code[2]}"
    done = subprocess.run(code, **how)
    assert (done.returncode, done.stderr) == (130, "forcegp: interrupted; nothing was begun.\n")
    done = subprocess.run(words, env={**os.environ, "PYTHONWARNINGS": "error"}, **how)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "no such file" in done.stderr
