"""Programs made at run time: C text compiled, kept in a folder that only the user may write to, loaded, called."""

import ctypes
import hashlib
import os
import platform
import re
import shlex
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, reduce
from operator import or_
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from forcegp.atomic_files import atomic_file
from forcegp.errors import CompilerError, InvalidInput

VARIABLE = "CC"
COMMANDS = ("cc", "gcc", "clang")
PACKAGES = "Debian: apt install gcc; Fedora: dnf install gcc; macOS: xcode-select --install; conda: conda install gcc"
LONGEST = 600.0  # seconds after which a compiler hangs: our longest program takes it a fiftieth of that
WITHOUT = "or do without it: a robot itself, predictor(compile=False), export_c(unchecked=True)"
ELSEWHERE = "choose another folder (the environment variable XDG_CACHE_HOME, robot.compile(folder=...))"
MOST_LANES, PER_THREAD = 8, 2048  # fewer states are done before another thread has started
NOT_FINITE, NOT_POSITIVE, RESULT_NOT_FINITE = 1, 2, 4  # what a program reports of its states: bits of its return value
# Lanes and compiler options by the vector unit that torch found.
VECTOR_UNITS = {"AVX512": (8, ("-mavx512f", "-mavx512dq", "-mavx512vl", "-mfma")), "AVX2": (4, ("-mavx2", "-mfma"))}
OPTIONS = ("-std=gnu11", "-O2", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast", "-fPIC", "-shared")


def compiler() -> list[str]:
    """The C compiler's command, with options from the variable CC. Raises CompilerError where there is none."""
    try:
        chosen = shlex.split(os.environ.get(VARIABLE, ""))
    except ValueError as error:
        seen = f"the environment variable {VARIABLE} is {os.environ[VARIABLE]!r}, which is no command ({error})"
        raise CompilerError(f"{seen}; correct it, {WITHOUT}.") from None
    for command in [chosen] if chosen else [[command] for command in COMMANDS]:
        if shutil.which(command[0]):
            return command
    looked_for = f"{chosen[0]!r}, which {VARIABLE} names" if chosen else ", ".join(COMMANDS)
    seen = f"compiled code needs a C compiler, and there is none here (looked for {looked_for})"
    raise CompilerError(f"{seen}; install one ({PACKAGES}), name it by the environment variable {VARIABLE}, {WITHOUT}.")


def compile_library(source: str, options: Iterable[str], library: Path, function: str) -> ctypes.CDLL:
    """Compile a C text to the shared library ``library``, and load it. CompilerError where ``function`` lacks."""
    command = compiler()
    whole = [*command, *options, "-x", "c", "-", "-o", str(library), "-lm"]
    try:
        done = subprocess.run(
            whole, input=source, capture_output=True, text=True, errors="replace", check=False, timeout=LONGEST
        )
        lines = [*done.stderr.strip().splitlines(), f"exit code {done.returncode}"]
        why = next((line for line in lines if "error" in line), lines[0]) if done.returncode else None
    except OSError as error:  # not a program
        why = str(error)
    except subprocess.TimeoutExpired:
        why = f"it did not end within {LONGEST:g} s"
    if why is None:
        try:
            loaded = ctypes.CDLL(str(library))
            getattr(loaded, function)
            return loaded
        except (OSError, AttributeError) as error:
            why = f"what it wrote cannot be loaded ({error}): its linker is broken, or no program may be run there"
    seen = f"the C compiler failed: {shlex.join(command)}: {why}"
    advice = f"name another (GCC or Clang) by the environment variable {VARIABLE}, {ELSEWHERE}, {WITHOUT}."
    raise CompilerError(f"{seen}; {advice}")


def require_plain(tensors: Iterable[Tensor], what: str, remedy: str) -> None:
    """Raise InvalidInput under transforms of torch.func and in forward mode, which machine code would drop."""
    transformed = torch._C._are_functorch_transforms_active()
    dual = forward_ad._current_level >= 0 and any(forward_ad.unpack_dual(x).tangent is not None for x in tensors)
    if transformed or dual:
        kind = "transforms of torch.func (vmap, grad, jacrev, ...)" if transformed else "forward-mode differentiation"
        raise InvalidInput(f"{what} does not support {kind}; {remedy}.")


def vector_unit() -> tuple[int, tuple[str, ...]]:
    """How many doubles are worked on at once, and the options of the compiler for it: what torch found."""
    return VECTOR_UNITS.get(torch.backends.cpu.get_cpu_capability(), (2, ()))


def default_folder() -> Path:
    """``$XDG_CACHE_HOME/forcegp/compiled``, or ``~/.cache/forcegp/compiled``."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "forcegp" / "compiled"


def load_library(
    name: str, key: str, write: Callable[[int], str], options: Sequence[str] = (), folder: Path | None = None
) -> ctypes.CDLL:
    """The library with the function `evaluate` of the C text that `write` gives for so many lanes, found or compiled.

    ``key`` must hold all that decides the text beside the code of this package; ``options`` are more of the compiler's.
    Raises CompilerError where there is no compiler, it fails, or the folder is not the user's own.
    """
    lanes, of_unit = vector_unit()
    parts = (key, *options, repr((lanes, of_unit)), repr(OPTIONS), platform.machine(), sys.platform, code_digest())
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    path = own_folder(folder) / f"{re.sub(r'[^A-Za-z0-9_]+', '-', name)[:60]}-{digest[:32]}.so"
    if not path.exists():
        source, compiled = write(lanes), (*OPTIONS, *of_unit, *options)
        try:
            with atomic_file(path) as library:  # whoever else compiles the same meanwhile
                compile_library(source, compiled, library, "evaluate")  # tried before it is kept
                library.chmod(0o700)
        except OSError as error:
            raise CompilerError(f"{path.parent} cannot be written to ({error.strerror}); {ELSEWHERE}.") from error
    return opened_library(path)


def opened_library(path: Path) -> ctypes.CDLL:
    """The library of a file that nobody else may write to. Raises CompilerError where it cannot be loaded."""
    own_file(path)
    try:
        library = ctypes.CDLL(str(path))
        library.evaluate.restype = ctypes.c_int
    except (OSError, AttributeError) as error:
        seen = f"{path} cannot be loaded ({error}); delete it, and it is compiled anew"
        advice = f"If that does not help, no program may be run from its folder: {ELSEWHERE}."
        raise CompilerError(f"{seen}. {advice}") from error
    return library


@cache
def code_digest() -> str:
    """Hash of the sources of this package: all that decide what is written, and more."""
    here = Path(__file__).parent.parent
    rooms = ("codegen", "robots", "mechanics", "forces", "inference", "posterior")
    files = sorted(path for room in rooms for path in (here / room).rglob("*") if path.suffix in (".py", ".c", ".h"))
    return hashlib.sha256(b"\0".join(path.read_bytes() for path in files)).hexdigest()


def own_folder(folder: Path | None = None) -> Path:
    """``folder`` without symbolic links, made if it is missing, where nobody else can put or exchange anything."""
    # what is checked is what is used, wherever a link points later
    folder = Path(os.path.realpath(folder or default_folder()))
    try:
        for part in (*reversed(folder.parents), folder):
            if not part.is_dir():
                part.mkdir(mode=0o700, exist_ok=True)  # another process may make it meanwhile
            own_file(part, parent=part != folder)
    except OSError as error:
        raise CompilerError(f"the folder {folder} cannot be made ({error.strerror}); {ELSEWHERE}.") from error
    return folder


def own_file(path: Path, *, parent: bool = False) -> None:
    """Nobody but the user and root may exchange it; in parents with the sticky bit, such as /tmp, only owners can."""
    if not hasattr(os, "getuid"):
        return
    status, danger = path.stat(), "and code from it would run with your rights"
    if status.st_uid not in (os.getuid(), 0):
        raise CompilerError(f"{path} belongs to another user, {danger}; {ELSEWHERE}, in folders of your own.")
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not (parent and status.st_mode & stat.S_ISVTX):
        seen = f"{path} can be written to by others than you, {danger}"
        raise CompilerError(f"{seen}; take that away (chmod go-w {shlex.quote(str(path))}), or {ELSEWHERE}.")


Tensors = Sequence[Tensor]


class RowFunction:
    """`evaluate` of a library, on flat `tables`: rows of numbers of length `outputs` from rows of so many `inputs`."""

    def __init__(self, library: ctypes.CDLL, inputs: int, outputs: Sequence[int], tables: Tensors = ()) -> None:
        self.library, self.inputs, self.outputs, self.tables = library, inputs, tuple(outputs), tuple(tables)
        self._tables = (ctypes.c_void_p * max(len(tables), 1))(*(x.data_ptr() for x in tables))
        self._evaluate = library.evaluate
        vectors = [ctypes.c_void_p, ctypes.c_long] * (inputs + len(outputs))
        self._evaluate.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, *vectors]

    def single(self, *inputs: Tensor) -> tuple[int, list[Tensor]]:
        """What is to be reported, and the outputs (size,) at one state (size,)."""
        made = [torch.empty(size, dtype=torch.float64) for size in self.outputs]
        given = [argument for x in (*inputs, *made) for argument in (x.data_ptr(), 1)]
        return self._evaluate(0, 1, self._tables, *given), made

    def rows(self, inputs: Tensors, outputs: Tensors, threads: int | None = None, least: int = PER_THREAD) -> int:
        """Fill contiguous `outputs` (count, size); what is to be reported. An input (1, size) serves all states.

        Batches of `least` states for each take as many threads as torch has, or `threads`.
        """
        count = len(outputs[0])
        parts = max(1, min(torch.get_num_threads() if threads is None else threads, count // least))
        steps = ((each, each.shape[1] if len(each) == count else 0) for each in (*inputs, *outputs))
        given = [x for each, step in steps for x in (each.data_ptr(), step)]
        bounds = [MOST_LANES * (count * k // parts // MOST_LANES) for k in range(parts)] + [count]

        def part(k: int) -> int:
            return self._evaluate(bounds[k], bounds[k + 1], self._tables, *given)

        if parts == 1:
            return part(0)
        others = [_pool(parts - 1, os.getpid()).submit(part, k) for k in range(1, parts)]
        return reduce(or_, (other.result() for other in others), part(0))


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Threads that stay, for to start them takes as long as many states; those of a parent process are not there."""
    return ThreadPoolExecutor(threads)


def are_plain(given: Sequence[object], size: int) -> bool:
    """Whether these are tensors (size,) or (n, size), all of one shape, that need neither conversion nor a graph."""
    shape = getattr(given[0], "shape", ()) if given else (size,)
    if len(shape) not in (1, 2) or shape[-1:] != (size,):
        return False
    for x in given:  # not a generator: every prediction of one state passes here
        if type(x) is not Tensor or x.shape != shape or x.dtype is not torch.float64:
            return False
        if x.requires_grad or not x.is_cpu or not x.is_contiguous():
            return False
    return True


def as_plain(given: Any) -> Any:
    """A vector of an array as a tensor; everything else as it is."""
    plain = type(given) is np.ndarray and given.dtype == np.float64 and given.ndim == 1
    return torch.tensor(given) if plain else given


def aligned(values: np.ndarray) -> Tensor:
    """The numbers at an address that is a multiple of 64 bytes."""
    held = torch.empty(values.size + 8, dtype=torch.float64)
    start = (-held.data_ptr() // 8) % 8
    held[start : start + values.size] = torch.from_numpy(np.ascontiguousarray(values))
    return held[start : start + values.size]
