"""C++ text as a loaded library."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

from forcegp.errors import CompilerError

OPTIONS = (
    "-std=c++17",
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=fast",
    "-fPIC",
    "-shared",
)


@cache
def cpp_library(source: str) -> ctypes.CDLL:
    """Compile `source` for this processor and load it; the same text is compiled once per process.

    Raises CompilerError where there is no C++ compiler, or where it fails.
    """
    compiler = _compiler()
    with tempfile.TemporaryDirectory(prefix="forcegp-") as work:  # nobody else can write there
        text, path = Path(work) / "code.cpp", Path(work) / "code.so"
        text.write_text(source, encoding="ascii")
        command = [*compiler, *OPTIONS, str(text), "-o", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        if done.returncode != 0:
            why = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
            raise CompilerError(
                f"the C++ compiler failed: {shlex.join(compiler)}: {why}; name another (GCC or Clang) by the "
                "environment variable CXX, or give compile=False, whose results are the same."
            )
        return ctypes.CDLL(str(path))


def _compiler() -> list[str]:
    chosen = shlex.split(os.environ.get("CXX", ""))
    for command in [chosen] if chosen else (["c++"], ["g++"], ["clang++"]):
        if shutil.which(command[0]):
            return command
    looked_for = f"{chosen[0]!r}, which the environment variable CXX names" if chosen else "c++, g++ or clang++"
    raise CompilerError(
        f"a compiled predictor needs a C++ compiler, and there is none here (looked for {looked_for}); install one "
        "(Debian, Ubuntu: apt install g++; Fedora: dnf install gcc-c++; macOS: xcode-select --install; conda: conda "
        "install gxx), name it by CXX, or give compile=False, whose results are the same."
    )
