"""What machine code made while the program runs needs: a compiler, and tensors whose derivatives it does not lose."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.autograd import forward_ad

from forcegp.errors import CompilerError, InvalidInput

VARIABLE = "CC"
COMMANDS = ("cc", "gcc", "clang")
PACKAGES = (
    "Debian, Ubuntu: apt install gcc; Fedora: dnf install gcc; macOS: xcode-select --install; conda: conda install gcc"
)
LONGEST = 600.0
"""Seconds after which a compiler hangs: our longest program takes it a fiftieth of that."""


@dataclass(frozen=True)
class Purpose:
    """What errors name: what is compiled, how another folder is chosen, and what works without a compiler."""

    what: str
    elsewhere: str
    instead: str

    def compiler(self) -> list[str]:
        """The command of the C compiler, with the options that the environment variable CC gives.

        Raises :class:`~forcegp.errors.CompilerError` where there is none.
        """
        try:
            chosen = shlex.split(os.environ.get(VARIABLE, ""))
        except ValueError as error:
            raise CompilerError(
                f"the environment variable {VARIABLE} is {os.environ[VARIABLE]!r}, which is no command "
                f"({error}); correct it, or {self.instead}, whose results are the same."
            ) from None
        for command in [chosen] if chosen else [[command] for command in COMMANDS]:
            if shutil.which(command[0]):
                return command
        looked_for = f"{', '.join(COMMANDS[:-1])} or {COMMANDS[-1]}"
        if chosen:
            looked_for = f"{chosen[0]!r}, which the environment variable {VARIABLE} names"
        raise CompilerError(
            f"{self.what} needs a C compiler, and there is none here (looked for {looked_for}); install one "
            f"({PACKAGES}), name it by {VARIABLE}, or {self.instead}, whose results are the same."
        )


def compile_library(source: str, options: Iterable[str], library: Path, function: str, purpose: Purpose) -> ctypes.CDLL:
    """Compile a C text to the shared library ``library``, and load it, which shows that it has ``function``.

    Raises :class:`~forcegp.errors.CompilerError` where there is no compiler, where it fails or does not end, and where
    nothing may be run from the folder.
    """
    compiler = purpose.compiler()
    command = [*compiler, *options, "-x", "c", "-", "-o", str(library), "-lm"]
    try:
        done = subprocess.run(
            command, input=source, capture_output=True, text=True, errors="replace", check=False, timeout=LONGEST
        )
        lines = done.stderr.strip().splitlines()
        named = next(
            (line for line in lines if "error" in line), lines[-1] if lines else f"exit code {done.returncode}"
        )
        why = named if done.returncode else None
    except OSError as error:  # not a program
        why = str(error)
    except subprocess.TimeoutExpired:
        why = f"it did not end within {LONGEST:g} s"
    if why is not None:
        raise CompilerError(
            f"the C compiler failed: {shlex.join(compiler)}: {why}; name another (GCC or Clang) by the "
            f"environment variable {VARIABLE}, or {purpose.instead}, whose results are the same."
        )
    try:
        loaded = ctypes.CDLL(str(library))
        getattr(loaded, function)
    except (OSError, AttributeError) as error:
        raise CompilerError(
            f"what the C compiler wrote cannot be loaded ({shlex.join(compiler)}: {error}): its linker "
            f"is broken, or no program may be run from {library.parent}; choose another folder ({purpose.elsewhere}), "
            f"name another compiler by {VARIABLE}, or {purpose.instead}, whose results are the same."
        ) from None
    return loaded


def require_plain(tensors: Iterable[Tensor], what: str, remedy: str) -> None:
    """Raise :class:`~forcegp.errors.InvalidInput` under transforms of torch.func and in forward-mode differentiation.

    Machine code reads the numbers of a tensor. What these two carry along with the numbers would be lost without a
    word; backward passes are recorded around the code instead.
    """
    transformed = torch._C._are_functorch_transforms_active()
    dual = forward_ad._current_level >= 0 and any(forward_ad.unpack_dual(x).tangent is not None for x in tensors)
    if transformed or dual:
        kind = "transforms of torch.func (vmap, grad, jacrev, ...)" if transformed else "forward-mode differentiation"
        raise InvalidInput(f"{what} does not support {kind}; {remedy}.")
