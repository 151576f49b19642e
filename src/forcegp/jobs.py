"""Pieces of work whose results are kept: `Job`, `JobStore`, a folder of finished jobs, and `run_jobs`.

What decides a result is digested: settings, inputs, all code of forcegp, and the package of the task's own module.
"""

import hashlib
import json
import os
import platform
import shutil
import sys
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from forcegp.atomic_files import atomic_folder, locked, read_json, remove_leftovers, require_writable, write_json
from forcegp.errors import BackendError, DataWarning, FileFormatError, FitError, ForceGPError, InvalidInput
from forcegp.parallel import Jobs, executor_for, outcome_of, stop, submit
from forcegp.progress import tell, watched

CODE = (".py", ".c", ".h", ".jinja")  # endings of the files that decide what a package computes
DESCRIPTION, JOBS, LOCK = "jobs.json", "jobs", ".lock"
RESULT_FILE = "job.json"
LIBRARIES = ("torch", "gpytorch", "scipy", "numpy")


@cache
def code_digest(*modules: str) -> str:
    """SHA-256 of forcegp and of these modules with their packages; modules without source count by their name."""
    digest = hashlib.sha256(repr(modules).encode())
    package, places = Path(__file__).parent, set[Path]()
    for module in modules:
        with suppress(ImportError):  # of a package that is no longer there: the job fails where it is computed
            found = sys.modules.get(module) or import_module(module)
            file = getattr(found, "__file__", None)  # which __main__ of a notebook lacks
            if module.partition(".")[0] != package.name and file is not None:
                places.add(Path(file).parent if found.__package__ else Path(file))
    for place in sorted({package, *places}):
        for source in [place] if place.is_file() else sorted(place.rglob("*")):
            if source.suffix in CODE:
                digest.update(f"{source.relative_to(place)}\0".encode() + source.read_bytes())
    return digest.hexdigest()


@cache
def machine() -> str:
    """Processor, cores and the versions that decide the numbers."""

    def of(library: str) -> str:
        with suppress(PackageNotFoundError):
            return version(library)
        return "missing"

    model = platform.processor() or platform.machine()
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    versions = ", ".join(f"{name} {of(name)}" for name in LIBRARIES)
    return f"{model}, {os.cpu_count()} cores; Python {platform.python_version()}, {versions}"


@dataclass(frozen=True)
class Job:
    """One piece of work, the smallest that is kept.

    name: its place in the store.
    task: "package.module:function" of a function `(store, spec, folder, *arguments)`, which may write files to `folder`
        and returns plain JSON values.
    spec: the settings of the task, plain JSON values.
    inputs: names of the jobs whose results the task reads.
    cost: about how many CPU seconds it takes, for the remaining time and the order.
    arguments: objects for the task that JSON cannot hold; `spec` must identify them.
    """

    name: str
    task: str
    spec: Mapping[str, Any]
    inputs: tuple[str, ...] = ()
    cost: float = field(default=1.0, compare=False)
    arguments: tuple[Any, ...] = field(default=(), compare=False, repr=False)

    @property
    def code_digest(self) -> str:
        """The digest of the code that computes it."""
        return code_digest(self.task.partition(":")[0])


def digests(jobs: Sequence[Job]) -> dict[str, str]:
    """By name, what decides each result: the task, its code and spec, and the digests of its inputs, which are jobs."""
    by_name = {job.name: job for job in jobs}

    @cache
    def digest(name: str) -> str:
        job = by_name[name]
        decisive = [job.task, job.code_digest, dict(job.spec), [digest(other) for other in job.inputs]]
        return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()

    return {name: digest(name) for name in by_name}


@dataclass(frozen=True)
class JobStore:
    """Results by name in `folder/jobs/<name>/job.json`, beside files of the task; kind: the command that owns it."""

    folder: Path
    kind: str = "forcegp"

    @classmethod
    def open(
        cls, folder: Path, kind: str, configuration: Mapping[str, Any], *, overwrite: bool | None = None
    ) -> "JobStore":
        """The folder, made if it does not exist, for jobs of this kind under one configuration of JSON values.

        With `overwrite` everything is computed anew; None for commands that do not offer it. Raises InvalidInput for a
        folder of something else or of another configuration, naming what differs.
        """
        wanted = json.loads(json.dumps(dict(configuration)))  # as JSON stores it
        store = cls(folder.absolute(), kind)  # processes that compute may be in another folder
        description = folder / DESCRIPTION
        if description.exists():
            stored = read_json(description, f"choose another `folder`, or delete {folder}")
            ours = stored.get("kind") == kind
        else:
            stored = {"configuration": wanted}
            ours = not folder.exists() or (folder.is_dir() and all(map(_is_own_start, folder.iterdir())))
        if not ours:
            raise InvalidInput(f"{folder} exists and was not written by `{kind}`; choose another `folder`.")
        before = stored.get("configuration") or {}
        differing = sorted(name for name in {*before, *wanted} if before.get(name) != wanted.get(name))
        if differing and not overwrite:
            given = [(name, f"{name} ({before.get(name)!r}, not {wanted.get(name)!r})") for name in differing]
            named = ", ".join(text if len(text) < 80 else name for name, text in given)
            more = "" if overwrite is None else ", or add `overwrite=True` to compute everything anew"
            raise InvalidInput(f"{folder} holds results with another {named}; choose another `folder`{more}.")
        if overwrite or not description.exists():
            folder.mkdir(parents=True, exist_ok=True)
            with store.locked():
                shutil.rmtree(folder / JOBS, ignore_errors=True)
                (folder / JOBS).mkdir()
                write_json(description, {"kind": kind, "configuration": wanted})
        return store

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Only one process works on the folder; the lock ends with its process. Raises InvalidInput if another does."""
        working = f"another `{self.kind}` is at work in {self.folder}; wait for it, or choose another `folder`."
        with locked(self.folder / LOCK, working):
            yield

    def place(self, name: str) -> Path:
        """The folder where the job of this name lies, or will lie."""
        return self.folder / JOBS / name

    def has(self, name: str, digest: str) -> bool:
        """Whether the job is finished, with this digest. Raises as `load`."""
        return self.place(name).exists() and self.load(name)["digest"] == digest

    def load(self, name: str) -> dict[str, Any]:
        """All that is stored of a finished job. Raises FileFormatError if it is damaged."""
        file = self.place(name) / RESULT_FILE
        remedy = f"delete the folder {file.parent} and run the same command again: only this job is computed anew"
        stored = read_json(file, remedy)
        if not {"digest", "code", "spec", "result"} <= set(stored):
            raise FileFormatError(f"{file} is half written; {remedy}.")
        return stored

    def result(self, name: str) -> dict[str, Any]:
        """The `result` of a finished job."""
        return self.load(name)["result"]


def _is_own_start(entry: Path) -> bool:
    """What a run leaves that is killed before it has written its description."""
    return entry.name in (LOCK, JOBS) or (entry.name.startswith(f".{DESCRIPTION}.") and entry.name.endswith(".tmp"))


def run_jobs(store: JobStore, jobs: Sequence[Job], at_once: Jobs = 1) -> int:
    """Compute all jobs that the store lacks, so many at once, or in an executor; returns how many.

    Every finished job is kept at once; one that fails stops only what depends on it. Results of other code or settings
    are computed anew, with a warning. Raises FitError at the end if any job has failed, BackendError if a worker died.
    """
    wanted = digests(jobs)
    if all(store.has(name, digest) for name, digest in wanted.items()):
        return 0
    with store.locked():
        remove_leftovers(store.folder)
        waiting = {job.name: job for job in jobs if not store.has(job.name, wanted[job.name])}
        require_writable(store.place("trial"))
        if old := [name for name in waiting if store.place(name).exists()]:
            warnings.warn(
                f"{len(old)} of the results in {store.folder}, {old[0]} for example, were computed by other code or "
                "with other settings; they are computed anew.",
                DataWarning,
                stacklevel=2,
            )
        try:
            return _compute_all(store, waiting, wanted, at_once)
        finally:
            remove_leftovers(store.folder)


def _compute_all(store: JobStore, waiting: dict[str, Job], wanted: Mapping[str, str], at_once: Jobs) -> int:
    """Each job after its inputs, and of those that can begin the longest first; how many were waiting."""
    executor, at_work = executor_for(at_once), dict[Future[Any], Job]()
    count, total, cost, full = len(waiting), sum(job.cost for job in waiting.values()), 0.0, False
    most = at_once if isinstance(at_once, int) else count
    finished, failed = set(wanted.keys() - waiting.keys()), dict[str, str]()

    def kept() -> str:
        done = count - len(waiting) - len(at_work) - len(failed)
        return f"{done} of {count} jobs are kept, so the same command goes on from here"

    try:
        while True:
            ready = [job for job in waiting.values() if not full and finished.issuperset(job.inputs)]
            for job in sorted(ready, key=lambda job: -job.cost)[: most - len(at_work)]:
                del waiting[job.name]
                bare = replace(job, arguments=())  # arguments go by themselves
                known = {"digest": wanted[job.name], "code": job.code_digest}
                at_work[submit(executor, compute, store, bare, known, *job.arguments)] = job
            if not at_work:
                break  # what still waits depends on jobs that failed
            for future in wait(at_work, return_when=FIRST_COMPLETED).done:
                job = at_work[future]
                try:
                    outcome_of(future)
                    finished.add(job.name)
                except BackendError:
                    raise
                except Exception as error:  # also a defect in one job must not cost what other jobs have done
                    own = isinstance(error, ForceGPError | OSError)
                    failed[job.name] = str(error) if own else f"{type(error).__name__}: {error}"
                    full |= isinstance(error, OSError)  # a full disk, say: what others compute could not be kept either
                del at_work[future]
                cost += job.cost
                note = f"{count - len(waiting) - len(at_work)} of {count} jobs, last {job.name}"
                tell(int(cost * 10), max(1, int(total * 10)), note)
    except BackendError as error:
        raise BackendError(f"{error}. {kept()}") from None
    finally:
        stop(executor, at_work)
    if failed:
        name, cause = next(iter(failed.items()))
        others = f" and {len(failed) - 1} more failed" if len(failed) > 1 else " failed"
        skipped = f", {len(waiting)} that need them were left out" if waiting else ""
        raise FitError(f"{name}{others}{skipped} ({cause}); {kept()}")
    return count


def compute(store: JobStore, job: Job, digests: Mapping[str, str], *arguments: Any) -> None:
    """Compute one job and keep it with its digests."""
    module, _, function = job.task.partition(":")
    task, start, wall = getattr(import_module(module), function), time.process_time(), time.monotonic()
    with atomic_folder(store.place(job.name)) as folder, warnings.catch_warnings(record=True) as caught, watched(None):
        folder.mkdir()
        warnings.simplefilter("always")
        result = task(store, job.spec, folder, *arguments)
        spent = {"cpu_seconds": time.process_time() - start, "wall_seconds": time.monotonic() - wall}
        told = {"warnings": sorted({str(warning.message) for warning in caught}), "machine": machine()}
        stored = {**digests, "task": job.task, "spec": dict(job.spec), "result": result, **spent, **told}
        write_json(folder / RESULT_FILE, stored)
