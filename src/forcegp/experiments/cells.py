"""Cells: the smallest pieces of an experiment that are computed, kept and never computed twice."""

from __future__ import annotations

import hashlib
import json
import os
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any

from forcegp.errors import FitError, ForceGPError
from forcegp.experiments.machine import machine
from forcegp.experiments.results import CELL_FILE, Results, write_json

Task = Callable[[Results, Mapping[str, Any], Path], dict[str, Any]]
"""`task(results, spec, folder)`: computes one cell, may write files to `folder`, returns plain JSON values."""

Progress = Callable[[int, int, str], None]
"""Called as `progress(work done, work in total, note)`; work is an estimate in CPU seconds."""


@dataclass(frozen=True)
class Cell:
    """One piece of work.

    name: its place in the results folder; task: "package.module:function"; spec: what the function
    is told, plain JSON values; after: the cells that it is made from, which must be finished before; cost: about how
    many CPU seconds it takes, for the remaining time and the order.
    """

    name: str
    task: str
    spec: Mapping[str, Any]
    after: tuple[str, ...] = ()
    cost: float = field(default=1.0, compare=False)


def run_cells(results: Results, cells: Sequence[Cell], jobs: int = 1, progress: Progress | None = None) -> int:
    """Compute all cells that are not there yet, `jobs` at once in separate processes; returns how many.

    Every finished cell is kept at once, so a run that is killed at any moment goes on where it was. A cell that fails
    stops only what depends on it. Raises FitError at the end if any has failed, naming the first.
    """
    wanted = digests(cells)
    if all(results.has(name, digest) for name, digest in wanted.items()):
        return 0
    with results.locked():
        results.remove_leftovers()
        missing = {cell.name: cell for cell in cells if not results.has(cell.name, wanted[cell.name])}
        if missing:
            _Run(results, missing, wanted, progress).with_processes(jobs)
    return len(missing)


def digests(cells: Sequence[Cell]) -> dict[str, str]:
    """What decides the result of every cell: its task, its spec and the digests of the cells that it is made from."""
    by_name = {cell.name: cell for cell in cells}
    out: dict[str, str] = {}

    def digest(cell: Cell) -> str:
        if cell.name not in out:
            made_of = [cell.task, dict(cell.spec), [digest(by_name[name]) for name in cell.after]]
            out[cell.name] = hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()
        return out[cell.name]

    for cell in cells:
        digest(cell)
    return out


class _Run:
    """The cells that wait, those that run, and those that are done."""

    def __init__(
        self, results: Results, missing: Mapping[str, Cell], wanted: Mapping[str, str], progress: Progress | None
    ) -> None:
        self.results = results
        self.digests = wanted
        self.waiting = dict(missing)
        self.total = sum(cell.cost for cell in missing.values())
        self.count = len(missing)
        self.done: list[str] = []
        self.done_cost = 0.0
        self.failed: dict[str, str] = {}
        self.progress = progress

    def with_processes(self, jobs: int) -> None:
        # spawn: a forked child would inherit the threads of BLAS in an unknown state
        context, before = get_context("spawn"), set(active_children())
        with ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin_worker, initargs=(os.getpid(),)) as pool:
            running: dict[Future[None], Cell] = {}
            try:
                while self.waiting or running:
                    for cell in self._ready(jobs - len(running)):
                        running[pool.submit(compute, self.results, cell, self.digests[cell.name])] = cell
                    if not running:
                        break  # what still waits depends on cells that failed
                    finished, _ = wait(running, return_when=FIRST_COMPLETED)
                    for future in finished:
                        self._record(running.pop(future), future)
            except BaseException:
                workers = set(active_children()) - before
                for worker in workers:
                    worker.terminate()
                for worker in workers:
                    worker.join()  # before the lock is given back: none of them may finish a cell after that
                self.results.remove_leftovers()
                raise
        if self.failed:
            name, cause = next(iter(self.failed.items()))
            others = f" and {len(self.failed) - 1} more failed" if len(self.failed) > 1 else " failed"
            skipped = f", {len(self.waiting)} that need them were left out" if self.waiting else ""
            raise FitError(
                f"{name}{others}{skipped} ({cause}); {len(self.done)} of {self.count} cells are kept, so the same "
                "command goes on from here"
            )

    def _ready(self, free: int) -> list[Cell]:
        """The next cells whose conditions are fulfilled: those that others wait for longest come first."""
        ready = [cell for cell in self.waiting.values() if all(self._finished(name) for name in cell.after)]
        ready.sort(key=lambda cell: -self._work_behind(cell.name))
        chosen = ready[: max(free, 0)]
        for cell in chosen:
            del self.waiting[cell.name]
        return chosen

    def _finished(self, name: str) -> bool:
        return self.results.cell_folder(name).exists()

    def _work_behind(self, name: str) -> float:
        """Cost of this cell and of the longest chain of cells that wait for it."""
        cell = self.waiting[name]
        return cell.cost + max(
            (self._work_behind(other.name) for other in self.waiting.values() if name in other.after), default=0.0
        )

    def _record(self, cell: Cell, future: Future[None]) -> None:
        try:
            future.result()
            self.done.append(cell.name)
        except BrokenProcessPool:
            raise FitError(
                f"a process died while {cell.name} or another cell was at work, probably for want of memory; "
                f"{len(self.done)} of {self.count} cells are kept, so the same command goes on from here, with fewer "
                "--jobs if memory is short"
            ) from None
        except ForceGPError as error:
            self.failed[cell.name] = str(error)
        except Exception as error:  # also a defect in one cell must not cost what other cells have done
            self.failed[cell.name] = f"{type(error).__name__}: {error}"
        self.done_cost += cell.cost
        if self.progress is not None:
            note = f"{len(self.done) + len(self.failed)} of {self.count} cells, last {cell.name}"
            self.progress(int(self.done_cost * 10), max(1, int(self.total * 10)), note)


def compute(results: Results, cell: Cell, digest: str) -> None:
    """Compute one cell and keep it."""
    module, _, function = cell.task.partition(":")
    task: Task = getattr(import_module(module), function)
    start, wall = time.process_time(), time.monotonic()
    with results.writing(cell.name) as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = task(results, cell.spec, folder)
        stored = {
            "digest": digest,
            "task": cell.task,
            "spec": dict(cell.spec),
            "machine": machine(),
            "result": result,
            "cpu_seconds": time.process_time() - start,
            "wall_seconds": time.monotonic() - wall,
            "warnings": sorted({str(warning.message) for warning in caught}),
        }
        write_json(folder / CELL_FILE, stored)


def _begin_worker(parent: int) -> None:
    """One thread per process, and no life without the parent: a killed run must not go on in its children."""
    import signal

    import torch
    from threadpoolctl import threadpool_limits

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its children itself
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch.set_num_threads(1)
    threadpool_limits(1)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
