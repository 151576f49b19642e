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


@dataclass(frozen=True)
class Language:
    """A language to compile from: who may compile it, in this order, unless the environment variable names another."""

    name: str
    option: str  # of the compiler, for a source text that has no file name
    variable: str
    commands: tuple[str, ...]
    packages: str  # how to install one

    def compiler(self, purpose: str, instead: str) -> list[str]:
        """The command of the compiler, with the options that the environment variable gives."""
        try:
            chosen = shlex.split(os.environ.get(self.variable, ""))
        except ValueError as error:
            raise CompilerError(
                f"the environment variable {self.variable} is {os.environ[self.variable]!r}, which is no command "
                f"({error}); correct it, or {instead}, whose results are the same."
            ) from None
        for command in [chosen] if chosen else [[command] for command in self.commands]:
            if shutil.which(command[0]):
                return command
        looked_for = f"{', '.join(self.commands[:-1])} or {self.commands[-1]}"
        if chosen:
            looked_for = f"{chosen[0]!r}, which the environment variable {self.variable} names"
        raise CompilerError(
            f"{purpose} needs a {self.name} compiler, and there is none here (looked for {looked_for}); install one "
            f"({self.packages}), name it by {self.variable}, or {instead}, whose results are the same."
        )


C = Language(
    "C",
    "c",
    "CC",
    ("cc", "gcc", "clang"),
    "Debian, Ubuntu: apt install gcc; Fedora: dnf install gcc; macOS: xcode-select --install; conda: conda install gcc",
)
CPP = Language(
    "C++",
    "c++",
    "CXX",
    ("c++", "g++", "clang++"),
    "Debian, Ubuntu: apt install g++; Fedora: dnf install gcc-c++; macOS: xcode-select --install; conda: conda install "
    "gxx",
)


def compile_library(
    language: Language,
    source: str,
    options: Iterable[str],
    library: Path,
    function: str,
    *,
    purpose: str,
    elsewhere: str,
    instead: str,
) -> ctypes.CDLL:
    """Compile a source text to the shared library ``library``, and load it, which shows that it has ``function``.

    ``purpose``, ``elsewhere`` and ``instead`` name in errors what needs the compiler, how to choose another folder, and
    what to do without a compiler. Raises :class:`~forcegp.errors.CompilerError` where there is no compiler, where it
    fails, and where nothing may be run from the folder.
    """
    compiler = language.compiler(purpose, instead)
    command = [*compiler, *options, "-x", language.option, "-", "-o", str(library)]
    try:
        done = subprocess.run(command, input=source, capture_output=True, text=True, errors="replace", check=False)
        why = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1] if done.returncode else None
    except OSError as error:  # not a program
        why = str(error)
    if why is not None:
        raise CompilerError(
            f"the {language.name} compiler failed: {shlex.join(compiler)}: {why}; name another (GCC or Clang) by the "
            f"environment variable {language.variable}, or {instead}, whose results are the same."
        )
    try:
        loaded = ctypes.CDLL(str(library))
        getattr(loaded, function)
    except (OSError, AttributeError) as error:
        raise CompilerError(
            f"what the {language.name} compiler wrote cannot be loaded ({shlex.join(compiler)}: {error}): its linker "
            f"is broken, or no program may be run from {library.parent}; choose another folder ({elsewhere}), name "
            f"another compiler by {language.variable}, or {instead}, whose results are the same."
        ) from None
    return loaded


def require_plain(tensors: Iterable[Tensor], what: str, remedy: str) -> None:
    """Raise :class:`~forcegp.errors.InvalidInput` under transforms of torch.func and in forward-mode differentiation.

    Machine code reads the numbers of a tensor. What these two carry along with the numbers would be lost without a
    word; backward passes are recorded around the code instead.
    """
    transformed = torch._C._are_functorch_transforms_active()
    if transformed or any(forward_ad.unpack_dual(x).tangent is not None for x in tensors):
        kind = "transforms of torch.func (vmap, grad, jacrev, ...)" if transformed else "forward-mode differentiation"
        raise InvalidInput(f"{what} does not support {kind}; {remedy}.")
