"""The real executable, and real files made by it, once for all tests of this room."""

import os
import subprocess
import sysconfig
from collections.abc import Callable
from pathlib import Path

import pytest

Forcegp = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def executable() -> Path:
    """The command that the installation put beside this Python."""
    found = Path(sysconfig.get_path("scripts")) / "forcegp"
    assert found.exists(), "forcegp is not installed in this environment: make test"
    return found


@pytest.fixture(scope="session")
def forcegp(executable) -> Forcegp:
    """Run `forcegp` with these arguments in that folder; returns exit code, stdout and stderr."""

    def run(*arguments: object, folder: Path | None = None, timeout: float = 300.0) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [executable, *(str(argument) for argument in arguments)],
            cwd=folder,
            env={**os.environ, "COLUMNS": "100"},
            capture_output=True,
            text=True,
            check=False,
            timeout=timeout,
        )

    return run


@pytest.fixture(scope="session")
def workshop(forcegp, tmp_path_factory) -> Path:
    """A folder with train.h5, test.h5 (2 s each) and the model `run` fitted to 15 points."""
    pytest.importorskip("pybullet")
    folder = tmp_path_factory.mktemp("workshop")
    for name, seed in (("train", 1), ("test", 2)):
        made = forcegp(
            "simulate", "kuka-surface", "--seconds", 2, "--seed", seed, "--out", f"{name}.h5", "--json", folder=folder
        )
        assert made.returncode == 0, made.stderr
        (folder / f"{name}.json").write_text(made.stdout)
    fitted = forcegp(
        *("fit", "train.h5", "--points", 15, "--iterations", 8, "--restarts", 2, "--seed", 3, "--out", "run"),
        folder=folder,
    )
    assert fitted.returncode == 0, fitted.stderr
    (folder / "fit.txt").write_text(fitted.stdout)
    return folder
