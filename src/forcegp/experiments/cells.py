"""Cells: the smallest pieces of an experiment that are computed, kept and never computed twice."""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from forcegp.errors import BackendError, FitError, ForceGPError
from forcegp.evaluation.machine import machine
from forcegp.experiments.packed_cells import PackedCell
from forcegp.experiments.results import CELL_FILE, Results, write_json
from forcegp.parallel import Backend, Joblib, Pool, Shared

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


def run_cells(
    results: Results, cells: Sequence[Cell], backend: Backend | None = None, progress: Progress | None = None
) -> int:
    """Compute all cells that are not there yet, on a backend (None: in one other process); returns how many.

    Every finished cell is kept at once, so a run that is killed at any moment goes on where it was. A cell that fails
    stops only what depends on it. Raises FitError at the end if any has failed, naming the first, and BackendError if
    workers cannot be had, or if those of one cell died again and again.
    """
    wanted = digests(cells)
    if all(results.has(name, digest) for name, digest in wanted.items()):
        return 0
    with results.locked():
        results.remove_leftovers()
        missing = {cell.name: cell for cell in cells if not results.has(cell.name, wanted[cell.name])}
        if missing:
            _Run(results, missing, wanted, progress).on(backend or Joblib(1), {cell.name: cell for cell in cells})
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

    def on(self, backend: Backend, every: Mapping[str, Cell]) -> None:
        """Compute all; `every` cell by name, also the finished ones."""
        sent: dict[str, Shared] = {}

        def submit(pool: Pool, cell: Cell) -> None:
            digest = self.digests[cell.name]
            if backend.shares_files:
                pool.submit(cell.name, compute, self.results, cell, digest)
                return
            before = _before(cell, every)
            for name in before:
                sent.setdefault(name, Shared(PackedCell.of(self.results, name)))
            pool.submit(cell.name, computed_elsewhere, cell, digest, *(sent[name] for name in before))

        try:
            with backend.pool() as pool:
                while self.waiting or len(pool):
                    for cell in self._ready(pool.free):
                        submit(pool, cell)
                    if not len(pool):
                        break  # what still waits depends on cells that failed
                    for name, future in pool.finished():
                        self._record(every[name], future)
        except BackendError as error:
            raise BackendError(f"{error}. {self._kept()}") from None
        finally:
            self.results.remove_leftovers()
        if self.failed:
            name, cause = next(iter(self.failed.items()))
            others = f" and {len(self.failed) - 1} more failed" if len(self.failed) > 1 else " failed"
            skipped = f", {len(self.waiting)} that need them were left out" if self.waiting else ""
            raise FitError(f"{name}{others}{skipped} ({cause}); {self._kept()}")

    def _kept(self) -> str:
        return f"{len(self.done)} of {self.count} cells are kept, so the same command goes on from here"

    def _ready(self, free: int | float) -> list[Cell]:
        """The next cells whose conditions are fulfilled: those that others wait for longest come first."""
        ready = [cell for cell in self.waiting.values() if all(self._finished(name) for name in cell.after)]
        ready.sort(key=lambda cell: -self._work_behind(cell.name))
        chosen = ready[: int(min(max(free, 0), len(ready)))]
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

    def _record(self, cell: Cell, future: Future[PackedCell | None]) -> None:
        try:
            packed = future.result()
            if packed is not None:
                packed.write(self.results)
            self.done.append(cell.name)
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


def computed_elsewhere(cell: Cell, digest: str, *before: PackedCell) -> PackedCell:
    """Compute one cell where the folder of results cannot be seen, from the cells that it needs."""
    with tempfile.TemporaryDirectory(prefix="forcegp-") as folder:
        results = Results(Path(folder))
        for packed in before:
            packed.write(results)
        compute(results, cell, digest)
        return PackedCell.of(results, cell.name)


def _before(cell: Cell, every: Mapping[str, Cell]) -> list[str]:
    """What the cell is made from, and what that is made from in turn, each once."""
    found: dict[str, None] = {}
    for name in cell.after:
        found |= dict.fromkeys([*_before(every[name], every), name])
    return list(found)
