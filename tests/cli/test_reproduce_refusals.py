"""What `forcegp reproduce` refuses before it computes anything."""

import os
import shutil
import subprocess
import sys

import pytest
from tests.cli.one_line import assert_refused

pytest.importorskip("pybullet")

REFUSALS = [
    ("fig9", "no figure 'fig9'"),
    ("fig2b --preset huge", "no preset 'huge'"),
    ("fig2b --jobs -1", "jobs is -1; give the number of tasks at once, at least 1"),
    ("fig2b --jobs 0", "jobs is 0; give the number of tasks at once"),
    ("fig2b --preset smoke --points 500", "its data have 400 rows, so give 2 to 400"),
    ("fig2b --preset smoke --points 1", "asked for 1 training points"),
    ("fig2b --seed-list -3", "--seed-list"),
    ("friction", "no figure 'friction'"),
]


@pytest.mark.parametrize(("words", "message"), REFUSALS, ids=[words for words, _ in REFUSALS])
def test_it_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, capfd, words, message):
    monkeypatch.chdir(tmp_path)
    assert_refused(f"reproduce {words} --out new", message, tmp_path, capfd)


@pytest.mark.nightly
def test_a_package_without_its_repository_names_what_to_clone_and_takes_that_of_the_current_folder(
    tmp_path, repository
):
    """As installed from a wheel: a copy of the package alone."""
    shutil.copytree(repository / "src" / "forcegp", tmp_path / "forcegp")
    (tmp_path / "empty").mkdir()

    def told(folder, *command):
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        words = [sys.executable, "-m", *command, "fig9"]
        return subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)

    alone = told(tmp_path / "empty", "forcegp", "reproduce")
    assert (alone.returncode, alone.stdout) == (2, "")
    assert alone.stderr.count("\n") == 1
    assert "git clone https://github.com/forcegp/forcegp" in alone.stderr
    assert not list((tmp_path / "empty").iterdir())
    for command in (("forcegp", "reproduce"), ("benchmarks.paper",)):
        beside = told(repository, *command)
        assert (beside.returncode, beside.stdout) == (2, "")
        assert "no figure 'fig9'" in beside.stderr
