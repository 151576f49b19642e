"""What machine code made while the program runs needs: a compiler, and tensors whose derivatives it does not lose."""

from __future__ import annotations

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
        chosen = shlex.split(os.environ.get(self.variable, ""))
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
    language: Language, source: str, options: Iterable[str], library: Path, *, purpose: str, instead: str
) -> None:
    """Compile a source text to the shared library ``library``.

    ``purpose`` and ``instead`` name in errors what needs the compiler and what to do without one. Raises
    :class:`~forcegp.errors.CompilerError` where there is no compiler or it fails, OSError where files cannot be
    written.
    """
    compiler = language.compiler(purpose, instead)
    command = [*compiler, *options, "-x", language.option, "-", "-o", str(library)]
    done = subprocess.run(command, input=source, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode != 0:
        why = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        raise CompilerError(
            f"the {language.name} compiler failed: {shlex.join(compiler)}: {why}; name another (GCC or Clang) by the "
            f"environment variable {language.variable}, or {instead}, whose results are the same."
        )


def require_plain(tensors: Iterable[Tensor], what: str, remedy: str) -> None:
    """Raise :class:`~forcegp.errors.InvalidInput` under transforms of torch.func and in forward-mode differentiation.

    Machine code reads the numbers of a tensor. What these two carry along with the numbers would be lost without a
    word; backward passes are recorded around the code instead.
    """
    transformed = torch._C._are_functorch_transforms_active()
    if transformed or any(forward_ad.unpack_dual(x).tangent is not None for x in tensors):
        kind = "transforms of torch.func (vmap, grad, jacrev, ...)" if transformed else "forward-mode differentiation"
        raise InvalidInput(f"{what} does not support {kind}; {remedy}.")
