"""`validate`: compute what is missing of a comparison, and write its page, figures and numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import forcegp.evaluation
import forcegp.validation
from forcegp.data.whole_files import write_json, write_text
from forcegp.errors import BackendError, InvalidInput
from forcegp.evaluation.machine import machine
from forcegp.parallel import Backend, Pool, Shared, backend_for
from forcegp.validation.candidates import DEFAULT_MODELS, candidates
from forcegp.validation.comparison import Cell, Comparison, cells_of, compute
from forcegp.validation.kept_cells import KeptCells
from forcegp.validation.page import page
from forcegp.validation.paired_tests import against_baseline, conclusions
from forcegp.validation.preparation_summary import preparation_lines
from forcegp.validation.summary import summary_of

RESULTS, PAGE = "results.json", "report.md"

Progress = Callable[[int, int, str], None]
"""Called as `progress(work done, work in total, note)`; work is a rough estimate."""


@dataclass(frozen=True)
class Validation:
    """What was found: `document` is all of results.json, `folder` where everything lies."""

    folder: Path
    document: Mapping[str, Any]

    @property
    def verdicts(self) -> list[str]:
        """A sentence for every question and score."""
        return [
            f"{item['question']} {answer['sentence']}"
            for item in self.document["verdicts"]
            for answer in item["answers"]
        ]


def validate(
    comparison: Comparison,
    folder: str | Path,
    *,
    models: Sequence[str] = DEFAULT_MODELS,
    seeds: int = 5,
    jobs: int | None = None,
    backend: Backend | str | None = None,
    source: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Validation:
    """Fit every model for every split and seed, score it on the rows held out, and write one page about all of them.

    Every finished piece is kept in `folder/cells` at once; the same call goes on after an interruption, and one with
    more models or seeds computes only these. A model that fails is a row that says why.

    Parameters
    ----------
    models: names as in `validation.candidates`.
    seeds: how many choices of training rows, numbered from 0.
    jobs, backend: how many pieces at once, and where: in this process, or in several of this machine.
    source: where the data come from, for the page: "title", and "data", a list of lines; plain JSON values.
    overwrite: compute everything anew, also where the folder holds results.

    Raises
    ------
    InvalidInput: an argument is out of range, the folder holds something else, or another process is at work there.
    """
    workers = backend_for(backend, jobs)
    if not workers.shares_files:
        raise InvalidInput(f"the backend {workers.name} does not share files; choose serial or joblib.")
    if isinstance(seeds, bool) or seeds < 1:
        raise InvalidInput(f"the number of seeds is {seeds}; it must be at least 1.")
    chosen = candidates(models, comparison.system, comparison.identification)
    configuration = comparison.configuration()
    kept = KeptCells.open(Path(folder), configuration, overwrite=overwrite)
    identifications, fits = cells_of(comparison, chosen, seeds)
    with kept.locked():
        kept.remove_leftovers()
        missing = [
            [cell for cell in stage if not kept.has(cell.file_name(comparison))] for stage in (identifications, fits)
        ]
        _Work(comparison, kept, [cell for stage in missing for cell in stage], progress).on(workers, missing)
        cells = {name: [_read(kept, comparison, cell) for cell in fits if cell.name == name] for name in chosen}
        document = _document(comparison, cells, chosen, seeds)
        document |= {"configuration": configuration, "source": dict(source or {})}
        document["identifications"] = [_brief(_read(kept, comparison, cell)) for cell in identifications]
        figures = forcegp.validation.figures_of(document)
        for name, figure in figures.items():
            forcegp.evaluation.save_figure(figure, kept.folder / f"{name}.png")
        document["figures"] = sorted(figures)
        write_json(kept.folder / RESULTS, document)
        write_text(kept.folder / PAGE, page(document))
    return Validation(kept.folder, document)


class _Work:
    """The pieces that are missing, and how far they are."""

    def __init__(
        self, comparison: Comparison, kept: KeptCells, missing: Sequence[Cell], progress: Progress | None
    ) -> None:
        self.comparison, self.kept, self.progress = comparison, kept, progress
        self.total = sum(cell.cost for cell in missing)
        self.count, self.done, self.done_cost = len(missing), 0, 0.0

    def on(self, backend: Backend, stages: Sequence[Sequence[Cell]]) -> None:
        """One stage after the other, for the second reads what the first has kept; costly pieces first."""
        for stage in stages:
            waiting = sorted(stage, key=lambda cell: cell.cost)
            if not waiting:
                continue
            comparison = Shared(self.comparison)
            try:
                with backend.pool() as pool:
                    while waiting or len(pool):
                        self._submit(pool, waiting, comparison)
                        for cell, future in pool.finished():
                            future.result()  # raises for a defect of this program: failures of models are kept
                            self._tell(cell)
            except BackendError as error:
                raise BackendError(
                    f"{error}. {self.done} of {self.count} pieces are kept; the same command goes on"
                ) from None

    def _submit(self, pool: Pool, waiting: list[Cell], comparison: Shared) -> None:
        while waiting and pool.free > 0:
            cell = waiting.pop()
            pool.submit(cell, compute, comparison, self.kept, cell)

    def _tell(self, cell: Cell) -> None:
        self.done += 1
        self.done_cost += cell.cost
        if self.progress is not None:
            note = f"{self.done} of {self.count} pieces, last {cell.name}, seed {cell.seed}"
            self.progress(int(10 * self.done_cost), max(1, int(10 * self.total)), note)


def _read(kept: KeptCells, comparison: Comparison, cell: Cell) -> dict[str, Any]:
    stored = kept.read(cell.file_name(comparison))
    assert stored is not None, "every cell was computed"
    return stored


def _document(
    comparison: Comparison, cells: Mapping[str, Sequence[Mapping[str, Any]]], chosen: Mapping[str, Any], seeds: int
) -> dict[str, Any]:
    summary = summary_of(cells, chosen)
    units = {name: comparison.rows.units[name] for name in ("q", "u", "a")}
    return {
        "kind": "forcegp validate",
        "machine": machine(),
        "joint_names": list(comparison.rows.joint_names),
        "units": {name: unit if isinstance(unit, str) else list(unit) for name, unit in units.items()},
        "preparation": preparation_lines(comparison.rows.metadata),
        "splits": [_described(comparison, split) for split in comparison.splits],
        "rows": len(comparison.rows),
        "points": comparison.points,
        "seeds": list(range(seeds)),
        "mass_matrix": sorted(
            {cell["result"]["mass_matrix"] for each in cells.values() for cell in each if cell["result"] is not None}
        ),
        "models": summary,
        "verdicts": conclusions(summary, cells),
        "against_baseline": against_baseline(summary, cells),
        "cells": {name: [_brief(cell) for cell in each] for name, each in cells.items()},
    }


def _described(comparison: Comparison, split: Any) -> dict[str, Any]:
    train, test = split.apply(comparison.rows)
    motions = comparison.motions(split)
    count = 0 if motions.motions is None else len(motions.motions.q)
    sides = {"training_rows": len(train), "test_rows": len(test), "motions": count, "notes": list(motions.notes)}
    return split.to_dict() | sides


def _brief(cell: Mapping[str, Any]) -> dict[str, Any]:
    """Without the system of an identification, which its own file holds."""
    result = cell["result"]
    if cell["kind"] == "identification" and result is not None:
        result = {name: value for name, value in result.items() if name != "system"}
    return {**cell, "result": result}
