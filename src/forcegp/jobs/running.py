"""`JobStore`, a folder of finished jobs, and `run_jobs`, which computes those that it lacks, each after its inputs."""

import json
import shutil
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from forcegp import __version__
from forcegp.atomic_files import atomic_folder, read_json, remove_leftovers, require_writable, write_json
from forcegp.errors import BackendError, FileFormatError, FitError, ForceGPError, InvalidInput, OutdatedWarning
from forcegp.jobs.job import Job, digests, machine
from forcegp.parallel import Jobs, executor_for, outcome_of, stop, submit

FORMAT_VERSION = 1
DESCRIPTION, JOBS, LOCK = "jobs.json", "jobs", ".lock"
RESULT_FILE = "job.json"


@dataclass(frozen=True)
class JobStore:
    """Results by name in `folder/jobs/<name>/job.json`, each beside the files that its task wrote.

    kind: the command that owns the folder, for messages.
    """

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
        store = cls(folder, kind)
        description = store._description()
        if description is None:
            if folder.exists() and (not folder.is_dir() or not all(map(_is_own_start, folder.iterdir()))):
                raise InvalidInput(f"{folder} exists and was not written by `{kind}`; choose another `folder`.")
        elif not overwrite:
            store._require_same(description["configuration"], configuration, can_overwrite=overwrite is not None)
            return store
        folder.mkdir(parents=True, exist_ok=True)
        with store.locked():
            shutil.rmtree(folder / JOBS, ignore_errors=True)
            (folder / JOBS).mkdir()
            content = {"kind": kind, "format_version": FORMAT_VERSION, "forcegp_version": __version__}
            write_json(folder / DESCRIPTION, {**content, "configuration": dict(configuration)})
        return store

    def _description(self) -> dict[str, Any] | None:
        """What the folder holds; None without a description."""
        if not (self.folder / DESCRIPTION).exists():
            return None
        stored = read_json(self.folder / DESCRIPTION, f"choose another `folder`, or delete {self.folder}")
        if stored.get("kind") != self.kind or not isinstance(stored.get("configuration"), dict):
            raise InvalidInput(f"{self.folder} was not written by `{self.kind}`; choose another `folder`.")
        if stored.get("format_version") != FORMAT_VERSION:
            raise FileFormatError(
                f"{self.folder} holds results of forcegp {stored.get('forcegp_version')} (format "
                f"{stored.get('format_version')}); this is {__version__} (format {FORMAT_VERSION}). Choose another "
                "`folder`."
            )
        return stored

    def _require_same(self, before: Mapping[str, Any], wanted: Mapping[str, Any], *, can_overwrite: bool) -> None:
        wanted = json.loads(json.dumps(wanted))  # as JSON stores it
        differing = sorted(name for name in {*before, *wanted} if before.get(name) != wanted.get(name))
        if differing:
            given = [f"{name} ({before.get(name)!r}, not {wanted.get(name)!r})" for name in differing]
            named = ", ".join(text if len(text) < 80 else name for name, text in zip(differing, given, strict=True))
            more = ", or add `overwrite=True` to compute everything anew" if can_overwrite else ""
            raise InvalidInput(f"{self.folder} holds results with another {named}; choose another `folder`{more}.")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Only one process works on the folder; the lock ends with its process. Raises InvalidInput if another does."""
        lock = FileLock(self.folder / LOCK)
        try:
            lock.acquire(blocking=False)
        except Timeout:
            raise InvalidInput(
                f"another `{self.kind}` is at work in {self.folder}; wait for it, or choose another `folder`."
            ) from None
        try:
            yield
        finally:
            lock.release()

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

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """A temporary folder that becomes the job's, in the place of an outdated one, and vanishes on failure."""
        with atomic_folder(self.place(name)) as folder:
            folder.mkdir()
            yield folder


def _is_own_start(entry: Path) -> bool:
    """What a run leaves that is killed before it has written its description."""
    return entry.name in (LOCK, JOBS) or (entry.name.startswith(f".{DESCRIPTION}.") and entry.name.endswith(".tmp"))


Progress = Callable[[int, int, str], None]
"""Called as `progress(work done, work in total, note)`; work is an estimate in CPU seconds."""


def run_jobs(store: JobStore, jobs: Sequence[Job], at_once: Jobs = 1, progress: Progress | None = None) -> int:
    """Compute all jobs that the store lacks, so many at once, or in an executor; returns how many.

    Every finished job is kept at once, so a run that is killed at any moment goes on where it was. A job that fails
    stops only what depends on it. Results of other code or settings are computed anew, with a warning. Raises FitError
    at the end if any job has failed, naming the first, and BackendError if a worker died.
    """
    wanted = digests(jobs)
    if all(store.has(name, digest) for name, digest in wanted.items()):
        return 0
    with store.locked():
        remove_leftovers(store.folder)
        by_name = {job.name: job for job in jobs}
        missing = {name: job for name, job in by_name.items() if not store.has(name, wanted[name])}
        if missing:
            require_writable(store.place("trial"))
            _warn_of_outdated(store, missing)
            _Run(store, by_name, dict(missing), wanted).on(at_once, progress)
    return len(missing)


def _warn_of_outdated(store: JobStore, missing: Mapping[str, Job]) -> None:
    """One sentence for what is there, but of other code or settings."""
    old = [job for job in missing.values() if store.place(job.name).exists()]
    if old:
        code = sum(store.load(job.name)["code"] != job.code_digest for job in old)
        by = {0: "with other settings", len(old): "by other code"}.get(code, "by other code or with other settings")
        warnings.warn(
            f"{len(old)} of the results in {store.folder}, {old[0].name} for example, were computed {by}; they are "
            "computed anew.",
            OutdatedWarning,
            stacklevel=3,
        )


class _Run:
    """The jobs that wait, and those that are done."""

    def __init__(self, store: JobStore, jobs: Mapping[str, Job], waiting: dict[str, Job], wanted: Mapping[str, str]):
        self.store, self.waiting, self.digests = store, waiting, wanted
        self.finished = jobs.keys() - waiting.keys()
        self.total, self.count = sum(job.cost for job in waiting.values()), len(waiting)
        self.done, self.done_cost = 0, 0.0
        self.failed: dict[str, str] = {}
        self.stopped = False

    def on(self, at_once: Jobs, progress: Progress | None) -> None:
        """Compute all."""
        executor, at_work = executor_for(at_once), dict[Future[Any], Job]()
        most = at_once if isinstance(at_once, int) else self.count
        try:
            while True:
                for job in self._ready(most - len(at_work)):
                    bare = replace(job, arguments=())  # arguments go by themselves
                    known = {"digest": self.digests[job.name], "code": job.code_digest}
                    at_work[submit(executor, compute, self.store, bare, known, *job.arguments)] = job
                if not at_work:
                    break  # what still waits depends on jobs that failed
                for future in wait(at_work, return_when=FIRST_COMPLETED).done:
                    job = at_work.pop(future)
                    self._record(job, future)
                    if progress is not None:
                        note = f"{self.done + len(self.failed)} of {self.count} jobs, last {job.name}"
                        progress(int(self.done_cost * 10), max(1, int(self.total * 10)), note)
        except BackendError as error:
            raise BackendError(f"{error}. {self._kept()}") from None
        finally:
            stop(executor, at_work)
            remove_leftovers(self.store.folder)
        if self.failed:
            name, cause = next(iter(self.failed.items()))
            others = f" and {len(self.failed) - 1} more failed" if len(self.failed) > 1 else " failed"
            skipped = f", {len(self.waiting)} that need them were left out" if self.waiting else ""
            raise FitError(f"{name}{others}{skipped} ({cause}); {self._kept()}")

    def _kept(self) -> str:
        return f"{self.done} of {self.count} jobs are kept, so the same command goes on from here"

    def _ready(self, free: int) -> list[Job]:
        """The next jobs whose inputs are finished, and which no longer wait: the longest come first."""
        ready = [job for job in self.waiting.values() if not self.stopped and self.finished.issuperset(job.inputs)]
        chosen = sorted(ready, key=lambda job: -job.cost)[:free]
        for job in chosen:
            del self.waiting[job.name]
        return chosen

    def _record(self, job: Job, future: Future[Any]) -> None:
        self.done_cost += job.cost
        try:
            outcome_of(future)
            self.done += 1
            self.finished.add(job.name)
        except BackendError:
            raise
        except ForceGPError as error:
            self.failed[job.name] = str(error)
        except OSError as error:  # a full disk, say: what others would compute could not be kept either
            self.failed[job.name], self.stopped = str(error), True
        except Exception as error:  # also a defect in one job must not cost what other jobs have done
            self.failed[job.name] = f"{type(error).__name__}: {error}"


def compute(store: JobStore, job: Job, digests: Mapping[str, str], *arguments: Any) -> None:
    """Compute one job and keep it with its digests."""
    module, _, function = job.task.partition(":")
    task = getattr(import_module(module), function)
    start, wall = time.process_time(), time.monotonic()
    with store.writing(job.name) as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = task(store, job.spec, folder, *arguments)
        stored = {
            **digests,
            "task": job.task,
            "spec": dict(job.spec),
            "machine": machine(),
            "result": result,
            "cpu_seconds": time.process_time() - start,
            "wall_seconds": time.monotonic() - wall,
            "warnings": sorted({str(warning.message) for warning in caught}),
        }
        write_json(folder / RESULT_FILE, stored)
