"""C++ text as a loaded library."""

from __future__ import annotations

import ctypes
import tempfile
from functools import cache
from pathlib import Path

from forcegp.codegen.native_code import CPP, compile_library
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
def cpp_library(source: str, function: str) -> ctypes.CDLL:
    """Compile `source`, which defines `function`, for this processor and load it; once per process.

    Raises CompilerError where there is no C++ compiler, where it fails, and where no folder for temporary files can be
    written to and run from.
    """
    texts = {"purpose": "a compiled predictor", "elsewhere": "TMPDIR", "instead": "give compile=False"}
    try:
        with tempfile.TemporaryDirectory(prefix="forcegp-") as work:  # nobody else can write there
            return compile_library(CPP, source, OPTIONS, Path(work) / "code.so", function, **texts)
    except OSError as error:
        raise CompilerError(
            f"a compiled predictor needs a folder for temporary files ({error}); choose another by TMPDIR, or give "
            "compile=False, whose results are the same."
        ) from None
