"""Programs that `export_c` wrote, as strict C99 without a warning, and stopped at what C leaves open."""

import ctypes
import subprocess
from pathlib import Path

import pytest

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
SANITIZED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
RK4 = pytest.param("rk4", marks=pytest.mark.nightly)  # the other explicit step covers it
IMPLICIT = pytest.param("implicit-midpoint", marks=pytest.mark.nightly)
PLAIN_AND_SANITIZED = pytest.mark.parametrize("options", [("-O1",), pytest.param(SANITIZED, marks=pytest.mark.nightly)])


def compiled(folder: Path, *files: str, optimized: int = 0) -> ctypes.CDLL:
    built(folder, *files, "-shared", "-fPIC", f"-O{optimized}", out="lib.so")
    return ctypes.CDLL(str(folder / "lib.so"))


def ran(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """What the program of these files, with these options, returned and printed."""
    built(folder, *arguments, out="program")
    return subprocess.run(["./program"], cwd=folder, capture_output=True, text=True, check=False)


def built(folder: Path, *arguments: str, out: str) -> None:
    command = ["cc", *STRICT, *arguments, "-o", out, "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
