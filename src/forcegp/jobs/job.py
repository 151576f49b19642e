"""`Job`: one piece of work, and the digest of all that decides its result, the source code included.

Imports are read from the source, not carried out. Followed are those into forcegp and into the module's own package;
other libraries are not, their versions stand in `machine`. `from forcegp.data import Dataset` and
`forcegp.data.Dataset` count the module that defines the name: packages re-export names from their modules, by imports
or by a stub `__init__.pyi` for lazy ones. C texts and templates beside a module that names them count, too. Comments,
docstrings, line breaks and imports for type checkers do not count.
Only what a program decides while it runs escapes, names of modules put together from pieces for example.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import platform
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

NAMED_FILE = re.compile(r"[\w/.-]+\.(c|h|jinja)")  # "lanes.h": what a module reads from a file beside it
OWN = __name__.partition(".")[0]
NAMED_IN_TEXT = re.compile(rf"({OWN}(?:\.\w+)+)(?::\w+)?")  # "forcegp.experiments.fits:fit": tasks and scenarios
Import = tuple[str, str | None]
"""A module, and the name that is taken from it; None for the module itself."""


@cache
def code_digest(*modules: str) -> str:
    """SHA-256 of the code of these modules and of what they import; modules without source count by their name."""
    digest = hashlib.sha256()
    for name, file in sorted(imported_files(*modules).items()):
        digest.update(f"{name}\0{'' if file is None else _source(file).digest}\0".encode())
    return digest.hexdigest()


def imported_files(*modules: str) -> dict[str, Path | None]:
    """The modules and all that they import from forcegp and their own packages: name -> file, None without source."""
    followed = {OWN, *(name.partition(".")[0] for name in modules)}
    files: dict[str, Path | None] = {}
    waiting: list[Import] = [(name, None) for name in modules]
    seen: set[Import] = set()
    while waiting:
        module, name = wanted = waiting.pop()
        if wanted in seen or module.partition(".")[0] not in followed:
            continue
        seen.add(wanted)
        if name is not None and _file(f"{module}.{name}") is not None:
            waiting.append((f"{module}.{name}", None))
        elif (file := _file(module)) is None:
            if name is None:
                files[module] = None
        else:
            files[module] = file
            waiting += _needed(module, file, name)
    return files


def _needed(module: str, file: Path, name: str | None) -> list[Import]:
    """What `from module import name` needs, beyond the module itself; without a name, all that the module needs."""
    if file.name != "__init__.py":
        return list(_source(file).imports(module.rpartition(".")[0]))
    stub = file.with_suffix(".pyi")
    exported = _source(stub if stub.is_file() else file)
    every = list(exported.imports(module, types=True))
    if name is None or name == "*":
        return every
    found = exported.exports(module).get(name)
    if found is not None or _source(file).lazy:
        return [] if found is None else [found]  # a lazy package imports nothing by itself
    return every  # it defines the name, from whatever it imports


@cache
def _file(module: str) -> Path | None:
    """The source of a module. Nothing but the outermost package is imported to find it."""
    loaded = getattr(sys.modules.get(module), "__file__", None)
    if loaded is not None and loaded.endswith(".py"):
        return Path(loaded)
    package, _, rest = module.partition(".")
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):  # ValueError: `__main__` of an interactive session
        return None
    if spec is None:
        return None
    if not rest:
        return Path(spec.origin) if spec.origin is not None and spec.origin.endswith(".py") else None
    for folder in spec.submodule_search_locations or ():
        path = Path(folder, *rest.split("."))
        for file in (path / "__init__.py", path.with_suffix(".py")):
            if file.is_file():
                return file
    return None


@dataclass(frozen=True, eq=False)
class _Source:
    tree: ast.Module
    digest: str

    @property
    def lazy(self) -> bool:
        """Whether names of the package are imported at their first use (PEP 562)."""
        return any(
            (isinstance(node, ast.FunctionDef) and node.name == "__getattr__")
            or (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id == "__getattr__")
            for node in ast.walk(self.tree)
        )

    def imports(self, package: str, *, types: bool = False) -> Iterator[Import]:
        """All imports, also those in functions; those for type checkers only if `types`."""
        nodes = list(self._nodes(types=types))
        aliases = (alias for node in nodes if isinstance(node, ast.Import) for alias in node.names)
        modules = {alias.asname or alias.name.partition(".")[0]: alias for alias in aliases}
        used: set[str] = set()
        for node in nodes:
            if isinstance(node, ast.ImportFrom):
                yield from ((_origin(node, package), alias.name) for alias in node.names)
            elif isinstance(node, ast.Attribute | ast.Name):
                first, _, rest = _dotted(node).partition(".")
                if first in modules and rest:
                    used.add(first)
                    module = modules[first].name if modules[first].asname else first
                    yield _split(f"{module}.{rest}")
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                named = NAMED_IN_TEXT.fullmatch(node.value)
                if named:
                    yield named[1], None
        for first, alias in modules.items():
            if first not in used:  # for what it does when it is imported
                yield alias.name, None

    def exports(self, package: str) -> dict[str, Import]:
        """The names that the module imports from others."""
        return {
            alias.asname or alias.name: (_origin(node, package), alias.name)
            for node in self._nodes(types=True)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }

    def _nodes(self, *, types: bool) -> Iterator[ast.AST]:
        """All nodes, without parts of dotted names; without what is for type checkers only unless `types`."""
        waiting: list[ast.AST] = [self.tree]
        while waiting:
            node = waiting.pop()
            yield node
            if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test) and not types:
                waiting += node.orelse
            elif not (isinstance(node, ast.Attribute) and _dotted(node)):
                waiting += ast.iter_child_nodes(node)


def _origin(node: ast.ImportFrom, package: str) -> str:
    """The module that `from ... import` names, also where it is relative to the package."""
    above = package.split(".")
    parents = above[: len(above) - node.level + 1] if node.level else []
    return ".".join([*parents, *([node.module] if node.module else [])])


def _dotted(node: ast.AST) -> str:
    """`a.b.c` as it stands; nothing for attributes of anything but names."""
    names = []
    while isinstance(node, ast.Attribute):
        names.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(names)]) if isinstance(node, ast.Name) else ""


def _split(dotted: str) -> Import:
    """`forcegp.data.Dataset.load` -> the module `forcegp.data` and its name `Dataset`."""
    parts = dotted.split(".")
    count = next((k for k in range(len(parts), 0, -1) if _file(".".join(parts[:k])) is not None), 1)
    return ".".join(parts[:count]), parts[count] if count < len(parts) else None


@cache
def _source(file: Path) -> _Source:
    tree = ast.parse(file.read_bytes(), str(file))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            body[:] = [part for part in body if not _is_text(part)]
    digest = hashlib.sha256(ast.dump(tree).encode())
    texts = (node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str))
    for name in sorted({text for text in texts if NAMED_FILE.fullmatch(text)}):
        if (file.parent / name).is_file():
            digest.update((file.parent / name).read_bytes())
    return _Source(tree, digest.hexdigest())


def _is_text(node: ast.AST) -> bool:
    """Whether a statement is a string alone: a docstring, also one below an attribute."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


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
