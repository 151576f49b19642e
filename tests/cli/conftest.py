"""`forcegp` in this process and as the installed executable, and real files made by it, once for all tests here."""

import os
import subprocess
import sysconfig
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.cli.in_process import Done, run_here

Forcegp = Callable[..., subprocess.CompletedProcess[str]]

LONGEST = 1200.0
"""Seconds after which a command hangs: hundreds of times what any of them takes, so no verdict depends on the clock."""


@pytest.fixture(scope="session")
def executable() -> Path:
    """The command that the installation put beside this Python."""
    found = Path(sysconfig.get_path("scripts")) / "forcegp"
    assert found.exists(), "forcegp is not installed in this environment: make test"
    return found


@pytest.fixture(scope="session")
def installed(executable) -> Forcegp:
    """Run the executable with these arguments in that folder; returns exit code, stdout and stderr."""
    # Each start imports torch anew: for what belongs to a process. `forcegp` does everything else

    def run(*arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [executable, *(str(argument) for argument in arguments)], cwd=folder, env={**os.environ, "COLUMNS": "100"},
            capture_output=True, text=True, check=False, timeout=LONGEST,
        )  # fmt: skip

    return run


@pytest.fixture(scope="session")
def forcegp() -> Callable[..., Done]:
    """Run `forcegp` with these arguments in that folder, in this process; returns exit code, stdout and stderr."""
    return run_here


@pytest.fixture(scope="session")
def workshop(forcegp, tmp_path_factory) -> Path:
    """A folder with train.h5, test.h5 (2 s each) and the model `run` fitted to 15 points."""
    folder = tmp_path_factory.mktemp("workshop")
    for name, seed in (("train", 1), ("test", 2)):
        words = ("simulate", "kuka-surface", "--seconds", 2, "--seed", seed, "--out", f"{name}.h5", "--json")
        (folder / f"{name}.json").write_text(forcegp(*words, folder=folder).ok().stdout)
    words = ("fit", "train.h5", "--forces", "gp:joint", "--points", 15, "--iterations", 8, "--restarts", 2)
    (folder / "fit.txt").write_text(forcegp(*words, "--out", "run", folder=folder).ok().stdout)
    return folder
