"""C text as a loaded library: compiled once, kept in a folder, loaded from there by later processes.

A file of the folder is named by a hash of everything that decides what is in it. Loading such a file runs the code in
it with the rights of the process. So only files of the folder are loaded, and only if the file, the folder and all
folders above it belong to the user (or to root) and no one else may write to them.

C of our own and not `torch.compile`: of the same scalars inductor made code in 156-184 s per function, gcc in 0.3 s,
which runs six times faster (`python -m benchmarks.compiled_dynamics inductor`), and this cache loads in 2 ms.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
import shlex
import stat
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch

from forcegp.atomic_files import atomic_file
from forcegp.codegen.native_code import Purpose, compile_library
from forcegp.errors import CompilerError

# Lanes and compiler options by the vector unit that torch found.
VECTOR_UNITS = {
    "AVX512": (8, ("-mavx512f", "-mavx512dq", "-mavx512vl", "-mfma")),
    "AVX2": (4, ("-mavx2", "-mfma")),
}
OPTIONS = ("-std=gnu11", "-O2", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-fPIC", "-shared")


@dataclass(frozen=True)
class VectorUnit:
    """How many doubles are worked on at once, and the options of the compiler for it."""

    lanes: int
    options: tuple[str, ...]

    @classmethod
    def of_this_processor(cls) -> VectorUnit:
        """What torch found."""
        return cls(*VECTOR_UNITS.get(torch.backends.cpu.get_cpu_capability(), (2, ())))


def default_folder() -> Path:
    """``$XDG_CACHE_HOME/forcegp/compiled``, or ``~/.cache/forcegp/compiled``."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "forcegp" / "compiled"


def load_library(
    name: str, key: str, write: Callable[[VectorUnit], str], folder: Path, purpose: Purpose
) -> tuple[ctypes.CDLL, Path]:
    """The library with the function `evaluate` that `write` gives the C text of, and its file.

    From ``folder`` if a file of that name and key is there, else compiled into it. ``key`` must hold everything that
    decides the text beside the code of this package. Raises :class:`~forcegp.errors.CompilerError` where there is no C
    compiler, where it fails, where ``folder`` cannot be written to, and where others than the user can write to it or
    to a folder above it.
    """
    unit = VectorUnit.of_this_processor()
    parts = (key, repr(unit), repr(OPTIONS), platform.machine(), sys.platform, code_digest())
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    path = own_folder(folder, purpose) / f"{re.sub(r'[^A-Za-z0-9_]+', '-', name)[:60]}-{digest[:32]}.so"
    if not path.exists():
        _compile(write(unit), unit.options, path, purpose)
    return opened_library(path, purpose), path


def opened_library(path: Path, purpose: Purpose) -> ctypes.CDLL:
    """The library of a file that nobody else may write to. Raises CompilerError where it cannot be loaded."""
    own_file(path, purpose)
    try:
        library = ctypes.CDLL(str(path))
        library.evaluate.restype = ctypes.c_int
    except (OSError, AttributeError) as error:
        raise CompilerError(
            f"{path} cannot be loaded ({error}); delete it, and it is compiled anew. If that does not help, choose "
            f"a folder from which programs may be run: {purpose.elsewhere}."
        ) from error
    return library


@cache
def code_digest() -> str:
    """Hash of the sources of this package: all that decide what is written, and more."""
    here = Path(__file__).parent.parent
    rooms = ("codegen", "robots", "mechanics", "priors", "inference", "models")
    files = sorted(path for room in rooms for path in (here / room).rglob("*.py"))
    return hashlib.sha256(b"\0".join(path.read_bytes() for path in files)).hexdigest()


def own_folder(folder: Path, purpose: Purpose) -> Path:
    """``folder`` without symbolic links, made if it is missing, where nobody else can put or exchange anything."""
    folder = Path(os.path.realpath(folder))  # what is checked is what is used, wherever a link points later
    try:
        for part in (*reversed(folder.parents), folder):
            if not part.is_dir():
                part.mkdir(mode=0o700, exist_ok=True)  # another process may make it meanwhile
            own_file(part, purpose, parent=part != folder)
    except OSError as error:
        raise CompilerError(
            f"the folder {folder} for {purpose.what} cannot be made ({error.strerror}); choose another: "
            f"{purpose.elsewhere}."
        ) from error
    return folder


def own_file(path: Path, purpose: Purpose, *, parent: bool = False) -> None:
    """Nobody but the user and root may exchange the file or what is in the folder.

    In a parent folder with the sticky bit, such as /tmp, everybody may make files, but exchange only their own.
    """
    if not hasattr(os, "getuid"):
        return
    status = path.stat()
    if status.st_uid not in (os.getuid(), 0):
        raise CompilerError(
            f"{path} belongs to another user, and code from it would run with your rights; choose a folder "
            f"that lies in folders of your own: {purpose.elsewhere}."
        )
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not (parent and status.st_mode & stat.S_ISVTX):
        raise CompilerError(
            f"{path} can be written to by others than you, and code from it would run with your rights; take that "
            f"away (chmod go-w {shlex.quote(str(path))}) or choose another folder: {purpose.elsewhere}."
        )


def _compile(source: str, options: tuple[str, ...], path: Path, purpose: Purpose) -> None:
    """Compile a source text to the library ``path``, whole or not at all."""
    try:
        with atomic_file(path) as library:  # whoever else compiles the same meanwhile
            compile_library(source, (*OPTIONS, *options), library, "evaluate", purpose)  # tried before it is kept
            library.chmod(0o700)
    except OSError as error:
        raise CompilerError(
            f"the folder {path.parent} for {purpose.what} cannot be written to ({error.strerror}); choose another: "
            f"{purpose.elsewhere}."
        ) from error
