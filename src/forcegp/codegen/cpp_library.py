"""C++ text as a loaded library."""

from __future__ import annotations

import ctypes
import tempfile
from functools import cache
from pathlib import Path

from forcegp.codegen.native_code import CPP, compile_library

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
    with tempfile.TemporaryDirectory(prefix="forcegp-") as work:  # nobody else can write there
        path = Path(work) / "code.so"
        compile_library(CPP, source, OPTIONS, path, purpose="a compiled predictor", instead="give compile=False")
        return ctypes.CDLL(str(path))
