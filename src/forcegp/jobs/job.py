"""`Job`: one piece of work, and the digest of all that decides its result, the source code included.

What counts is all of forcegp, and the files in the package of the task's own module where that is another; other
libraries do not, their versions stand in `machine`.
"""

import hashlib
import json
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

CODE = (".py", ".c", ".h", ".jinja")
"""Endings of the files that decide what a package computes."""


@cache
def code_digest(*modules: str) -> str:
    """SHA-256 of forcegp and of these modules with their packages; modules without source count by their name."""
    digest = hashlib.sha256(repr(modules).encode())
    package = Path(__file__).parents[1]
    foreign = {_place(module) for module in modules if module.partition(".")[0] != package.name}
    for place in sorted({package, *foreign} - {None}):
        for file in [place] if place.is_file() else sorted(place.rglob("*")):
            if file.suffix in CODE:
                digest.update(f"{file.relative_to(place)}\0".encode() + file.read_bytes())
    return digest.hexdigest()


def _place(module: str) -> Path | None:
    """The folder of the package that a module belongs to, or the file of a module without package."""
    try:
        found = sys.modules.get(module) or import_module(module)
    except ImportError:  # of a package that is no longer there: the job fails where it is computed
        return None
    file = getattr(found, "__file__", None)
    if file is None:
        return None
    return Path(file).parent if found.__package__ else Path(file)


@dataclass(frozen=True)
class Job:
    """One piece of work, the smallest that is kept.

    Fields
    ------
    name: its place in the store.
    task: "package.module:function" of a function `(store, spec, folder, *arguments)`, which may write files to `folder`
        and returns plain JSON values.
    spec: the settings of the task, plain JSON values.
    inputs: names of the jobs whose results the task reads.
    cost: about how many CPU seconds it takes, for the remaining time and the order.
    arguments: objects for the task that JSON cannot hold; `spec` must identify them.
    code: more modules that decide the result, those of functions among the arguments for example.
    """

    name: str
    task: str
    spec: Mapping[str, Any]
    inputs: tuple[str, ...] = ()
    cost: float = field(default=1.0, compare=False)
    arguments: tuple[Any, ...] = field(default=(), compare=False, repr=False)
    code: tuple[str, ...] = ()

    @property
    def code_digest(self) -> str:
        """The digest of the code that computes it."""
        return code_digest(self.task.partition(":")[0], *self.code)


def digests(jobs: Sequence[Job]) -> dict[str, str]:
    """By name, what decides each result: the task, its code and spec, and the digests of its inputs, which are jobs."""
    by_name = {job.name: job for job in jobs}
    out: dict[str, str] = {}

    def digest(job: Job) -> str:
        if job.name not in out:
            inputs = [digest(by_name[name]) for name in job.inputs]
            decisive = [job.task, job.code_digest, dict(job.spec), inputs]
            out[job.name] = hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()
        return out[job.name]

    for job in jobs:
        digest(job)
    return out


LIBRARIES = ("torch", "gpytorch", "scipy", "numpy", "pybullet")


@cache
def machine() -> str:
    """Processor, cores and the versions that decide the numbers."""
    model = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else ():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    versions = ", ".join(f"{name} {_version(name)}" for name in LIBRARIES)
    return f"{model}, {os.cpu_count()} cores; Python {platform.python_version()}, {versions}"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"
