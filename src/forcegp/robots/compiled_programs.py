"""Programs as machine code: written as C, compiled once, kept in a folder, loaded from there by later processes.

A file of the folder is named by a hash of everything that decides what is in it: the robot's constants, the request,
the sources of the modules that write the code, the processor's vector unit and the platform. Loading such a file runs
the code in it with the rights of the process. So only files of the folder are loaded, and only if the file, the folder
and all folders above it belong to the user (or to root) and no one else may write to them.

C of our own and not `torch.compile`: of the same unrolled scalars inductor made code in 156-184 s per function, gcc in
0.3 s, which runs six times faster (`python -m benchmarks.compiled_dynamics inductor`), and this cache loads in 2 ms.
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
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from forcegp.atomic_files import atomic_file
from forcegp.codegen.native_code import C, compile_library
from forcegp.errors import CompilerError
from forcegp.robots.dynamics_programs import Request, trace_dynamics
from forcegp.robots.machine_code import input_arrays, write_c
from forcegp.robots.unrolled import UnrolledRobot

SOURCES = ("scalar_algebra", "unrolled", "unrolled_kinematics", "expressions", "dynamics_programs", "machine_code")
STATES_PER_THREAD = 2048  # fewer are done before another thread has started

# Lanes and compiler options by the vector unit that torch found.
VECTOR_UNITS = {
    "AVX512": (8, ("-mavx512f", "-mavx512dq", "-mavx512vl", "-mfma")),
    "AVX2": (4, ("-mavx2", "-mfma")),
}
OPTIONS = ("-std=gnu11", "-O2", "-ffp-contract=fast", "-fPIC", "-shared")


def default_folder() -> Path:
    """``$XDG_CACHE_HOME/forcegp/dynamics``, or ``~/.cache/forcegp/dynamics``."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "forcegp" / "dynamics"


class CompiledProgram:
    """A program as a function in a loaded library."""

    def __init__(self, path: Path, arrays: tuple[str, ...]) -> None:
        self.arrays = arrays
        try:
            self._evaluate = ctypes.CDLL(str(path)).evaluate
        except (OSError, AttributeError) as error:
            raise CompilerError(
                f"{path} cannot be loaded ({error}); delete it, and it is compiled anew. If that does not help, choose "
                "a folder from which programs may be run: robot.compile(folder=...)."
            ) from error

    def __call__(self, count: int, inputs: Mapping[str, Tensor], outputs: Mapping[str, Tensor]) -> bool:
        """Fill ``outputs`` for ``count`` states; whether all that must be positive was.

        Inputs and outputs are contiguous float64 tensors (count, size) by name, or (1, size) for all states; an output
        (1, size) receives the sum over the states.
        """
        threads = max(1, min(torch.get_num_threads(), count // STATES_PER_THREAD))
        given = list(map(inputs.__getitem__, self.arrays))
        # each thread has sums of its own
        sums = {name: x.new_zeros(threads, 1, x.shape[1]) for name, x in outputs.items() if len(x) != count}
        bounds = [count * k // threads for k in range(threads + 1)]

        def part(thread: int) -> bool:
            filled = [sums[name][thread] if name in sums else x for name, x in outputs.items()]
            limits = ctypes.c_long(bounds[thread]), ctypes.c_long(bounds[thread + 1])
            return bool(self._evaluate(*limits, *_pointers(given, count), *_pointers(filled, count)))

        if threads == 1:
            good = part(0)
        else:
            with ThreadPoolExecutor(threads) as pool:  # ctypes lets other threads run meanwhile
                good = all(list(pool.map(part, range(threads))))
        for name, values in sums.items():
            outputs[name].copy_(values.sum(0))
        return good


def _pointers(tensors: list[Tensor], count: int) -> tuple[ctypes.Array, ctypes.Array]:
    size = len(tensors)
    strides = [x.shape[1] if len(x) == count else 0 for x in tensors]
    return (ctypes.c_void_p * size)(*(x.data_ptr() for x in tensors)), (ctypes.c_long * size)(*strides)


def compiled_program(unrolled: UnrolledRobot, request: Request, folder: Path) -> CompiledProgram:
    """The program of a request: from ``folder`` if it is there, else compiled into it.

    Raises :class:`~forcegp.errors.CompilerError` where there is no C compiler, where it fails, where ``folder`` cannot
    be written to, and where others than the user can write to it or to a folder above it.
    """
    capability = torch.backends.cpu.get_cpu_capability()
    lanes, options = VECTOR_UNITS.get(capability, (2, ()))
    name = re.sub(r"\W+", "-", unrolled.robot.name)[:40]
    key = _key(unrolled, request, (capability, str(lanes), *options, *OPTIONS))
    path = _own_folder(folder) / f"{name}-{request.function}-{key[:32]}.so"
    if not path.exists():
        compile_c(write_c(trace_dynamics(unrolled, request), request.inputs, lanes), options, path)
    _require_own(path)
    return CompiledProgram(path, input_arrays(request.inputs))


def _key(unrolled: UnrolledRobot, request: Request, machine: tuple[str, ...]) -> str:
    constants = [unrolled.joints, unrolled.gravity, unrolled.armature]
    if not request.free_inertias:
        constants.append(unrolled.inertias)
    parts = (repr(constants), repr(request), repr(machine), platform.machine(), sys.platform, _code())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


@cache
def _code() -> str:
    """Hash of the sources that decide what code is written."""
    here = Path(__file__).parent
    return hashlib.sha256(b"\0".join((here / f"{name}.py").read_bytes() for name in SOURCES)).hexdigest()


def _own_folder(folder: Path) -> Path:
    """``folder`` without symbolic links, made if it is missing, where nobody else can put or exchange anything."""
    folder = Path(os.path.realpath(folder))  # what is checked is what is used, wherever a link points later
    try:
        for part in (*reversed(folder.parents), folder):
            if not part.is_dir():
                part.mkdir(mode=0o700, exist_ok=True)  # another process may make it meanwhile
            _require_own(part, parent=part != folder)
    except OSError as error:
        raise CompilerError(
            f"the folder {folder} for compiled dynamics cannot be made ({error.strerror}); choose another: "
            "robot.compile(folder=...)."
        ) from error
    return folder


def _require_own(path: Path, *, parent: bool = False) -> None:
    """Nobody but the user and root may exchange the file or what is in the folder.

    In a parent folder with the sticky bit, such as /tmp, everybody may make files, but exchange only their own.
    """
    if not hasattr(os, "getuid"):
        return
    status = path.stat()
    if status.st_uid not in (os.getuid(), 0):
        raise CompilerError(
            f"{path} belongs to another user, and code from it would run with your rights; choose a folder "
            "that lies in folders of your own: robot.compile(folder=...)."
        )
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not (parent and status.st_mode & stat.S_ISVTX):
        raise CompilerError(
            f"{path} can be written to by others than you, and code from it would run with your rights; take that "
            f"away (chmod go-w {shlex.quote(str(path))}) or choose another folder: robot.compile(folder=...)."
        )


def compile_c(source: str, options: tuple[str, ...], path: Path) -> None:
    """Compile a source text to the library ``path``, whole or not at all."""
    try:
        with atomic_file(path) as library:  # whoever else compiles the same meanwhile
            compile_library(
                C,
                source,
                (*OPTIONS, *options),
                library,
                "evaluate",  # tried before it is kept
                purpose="compiled dynamics",
                elsewhere="robot.compile(folder=...)",
                instead="use the robot itself",
            )
            library.chmod(0o700)
    except OSError as error:
        raise CompilerError(
            f"the folder {path.parent} for compiled dynamics cannot be written to ({error.strerror}); choose another: "
            "robot.compile(folder=...)."
        ) from error
