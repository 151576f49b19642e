"""`forcegp` in this process, as if it were a process of its own."""

import contextlib
import ctypes
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Self

import pytest
import torch

from forcegp.cli.main import main

PYTHON_FILTERS = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)
"""Which warnings Python does not show where nobody asks for them: https://docs.python.org/3/library/warnings.html."""


class Done(subprocess.CompletedProcess[str]):
    def ok(self) -> Self:
        assert self.returncode == 0, self.stderr
        return self

    def refused(self, message: str = "") -> str:
        """The one line that says so, with this message."""
        assert self.returncode == 2, self.stderr
        (line,) = self.stderr.splitlines()
        assert self.stderr.count("\n") == 1
        assert message in line
        return line


def run_here(*arguments: object, folder: Path | None = None, columns: int = 100) -> Done:
    """Run `forcegp` with these arguments in that folder, in this process; returns exit code, stdout and stderr."""
    # Files, pipes and warnings are those of a new process, and what the command could change here is put back
    words = [str(argument) for argument in arguments]
    with contextlib.ExitStack() as undo:
        undo.callback(torch.set_num_threads, torch.get_num_threads())
        undo.enter_context(contextlib.chdir(folder or Path.cwd()))
        undo.enter_context(pytest.MonkeyPatch.context()).setenv("COLUMNS", str(columns))
        undo.enter_context(warnings.catch_warnings(action="default"))
        for category in PYTHON_FILTERS:
            warnings.simplefilter("ignore", category)
        stdout, stderr = (undo.enter_context(_into_a_file(name)) for name in ("stdout", "stderr"))
        try:
            code = main(words)
        except SystemExit as end:  # --help
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        texts = [_text(stream) for stream in (stdout, stderr)]
    return Done(["forcegp", *words], code, *texts)


@contextlib.contextmanager
def _into_a_file(name: str) -> Iterator[IO[bytes]]:
    """What Python, C and child processes write to that stream goes into a temporary file."""
    stream = getattr(sys, name)
    stream.flush()
    descriptor = {"stdout": 1, "stderr": 2}[name]
    kept = os.dup(descriptor)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), descriptor)
        ours = _like(name, descriptor)
        setattr(sys, name, ours)
        try:
            yield file
        finally:
            ours.close()  # which flushes, and leaves the descriptor
            setattr(sys, name, stream)
            os.dup2(kept, descriptor)
            os.close(kept)


def _like(name: str, descriptor: int) -> IO[str]:
    """A stream to that descriptor, with what Python does there to letters that cannot be encoded."""
    errors = {"stderr": "backslashreplace"}.get(name, "strict")
    return open(descriptor, "w", closefd=False, encoding="utf-8", errors=errors)


def _text(file: IO[bytes]) -> str:
    sys.stdout.flush()
    sys.stderr.flush()
    ctypes.CDLL(None).fflush(None)
    file.seek(0)
    return file.read().decode()
