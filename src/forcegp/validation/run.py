"""`validate`: compute what is missing of a comparison, and write its page, figures and numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import forcegp.evaluation
import forcegp.validation
from forcegp import __version__
from forcegp.atomic_files import write_json, write_text
from forcegp.errors import InvalidInput, require_type
from forcegp.jobs import JobStore, Progress, run_jobs
from forcegp.jobs.machine import machine
from forcegp.parallel import Backend, backend_for
from forcegp.validation.candidates import DEFAULT_MODELS, candidates
from forcegp.validation.comparison import Comparison
from forcegp.validation.jobs import jobs_of, kept
from forcegp.validation.page import page
from forcegp.validation.paired_tests import against_baseline, conclusions
from forcegp.validation.preparation_summary import preparation_lines
from forcegp.validation.summary import summary_of

KIND = "forcegp validate"
RESULTS, PAGE = "results.json", "report.md"


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

    Every finished piece is kept in `folder/jobs` at once; the same call goes on after an interruption, and one with
    more models or seeds computes only these. A model that fails is a row that names the error.

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
    require_type("comparison", comparison, Comparison)
    workers = backend_for(backend, jobs)
    if not workers.shares_files:
        raise InvalidInput(f"the backend {workers.name} does not share files; choose serial or joblib.")
    if isinstance(seeds, bool) or seeds < 1:
        raise InvalidInput(f"the number of seeds is {seeds}; it must be at least 1.")
    chosen = candidates(models, comparison.system, comparison.identification)
    configuration = comparison.configuration()
    store = JobStore.open(Path(folder), KIND, configuration, overwrite=overwrite)
    identifications, fits = jobs_of(comparison, chosen, seeds)
    run_jobs(store, [*identifications, *fits], workers, progress)
    runs = {name: [kept(store, job.name) for job in fits if job.spec["name"] == name] for name in chosen}
    document = _document(comparison, runs, chosen, seeds)
    document |= {"configuration": {"forcegp": __version__, **configuration}, "source": dict(source or {})}
    document["identifications"] = [_brief(kept(store, job.name)) for job in identifications]
    with store.locked():
        figures = forcegp.validation.figures_of(document)
        for name, figure in figures.items():
            forcegp.evaluation.save_figure(figure, store.folder / f"{name}.png")
        document["figures"] = sorted(figures)
        write_json(store.folder / RESULTS, document)
        write_text(store.folder / PAGE, page(document))
    return Validation(store.folder, document)


def _document(
    comparison: Comparison, runs: Mapping[str, Sequence[Mapping[str, Any]]], chosen: Mapping[str, Any], seeds: int
) -> dict[str, Any]:
    summary = summary_of(runs, chosen)
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
            {run["result"]["mass_matrix"] for each in runs.values() for run in each if run["result"] is not None}
        ),
        "models": summary,
        "verdicts": conclusions(summary, runs),
        "against_baseline": against_baseline(summary, runs),
        "runs": {name: [_brief(run) for run in each] for name, each in runs.items()},
    }


def _described(comparison: Comparison, split: Any) -> dict[str, Any]:
    train, test = split.apply(comparison.rows)
    motions = comparison.motions(split)
    count = 0 if motions.motions is None else len(motions.motions.q)
    sides = {"training_rows": len(train), "test_rows": len(test), "motions": count, "notes": list(motions.notes)}
    return split.to_dict() | sides


def _brief(run: Mapping[str, Any]) -> dict[str, Any]:
    """Without the system of an identification, which its own file holds."""
    result = run["result"]
    if run["kind"] == "identification" and result is not None:
        result = {name: value for name, value in result.items() if name != "system"}
    return {**run, "result": result}
