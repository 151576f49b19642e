"""Run experiments and write what they found: JSON, CSV, figures and one page of Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from forcegp import __version__
from forcegp.atomic_files import require_writable, write_json, write_text
from forcegp.errors import InvalidInput
from forcegp.evaluation import save_figure
from forcegp.experiments.experiment import Experiment, Row
from forcegp.experiments.pages import page_of
from forcegp.experiments.report import report
from forcegp.jobs import JobStore, Progress, run_jobs
from forcegp.parallel import Backend

KIND = "forcegp reproduce"


def reproduce(
    experiments: Sequence[Experiment],
    preset: str,
    out: Path,
    *,
    command: str,
    docs: Path | None = None,
    backend: Backend | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compute what is missing in the folder `out`, then write all summaries; returns them by experiment.

    Writes the page (`page_name`) and, in the folder of its name (`page_of`), `<name>.json`, `<name>.csv` and the
    figures as PNG, into `out` and, if given, into `docs`, too. `command` is the command that the page
    names as its source.
    Raises InvalidInput for experiments that the data do not allow and for folders that cannot be written, and as
    `JobStore.open` and `run_jobs`.
    """
    for experiment in experiments:
        experiment.require_possible()
    results = JobStore.open(out, KIND, {"preset": preset})
    for root in (out, docs) if docs is not None else (out,):
        _make_folder(root / page_of(preset).name)
    jobs = {job.name: job for experiment in experiments for job in experiment.jobs()}
    run_jobs(results, list(jobs.values()), backend, progress)
    documents, pictures, tables = {}, {}, {}
    for experiment in experiments:
        summary = experiment.summary(results)
        figures = experiment.figures(summary, results)
        stored = {job.name: results.load(job.name) for job in experiment.jobs()}
        documents[experiment.name] = {
            "kind": KIND,
            "forcegp_version": __version__,
            "preset": preset,
            "command": command,
            "config": experiment.config(),
            "figures": list(figures),
            "machines": sorted({job["machine"] for job in stored.values()}),
            "cpu_seconds": {name: job["cpu_seconds"] for name, job in stored.items()},
            "warnings": {name: job["warnings"] for name, job in stored.items() if job["warnings"]},
            "summary": summary,
        }
        pictures |= figures
        tables[experiment.name] = as_csv(experiment.rows(summary))
    for root in (out, docs) if docs is not None else (out,):
        _publish(root, preset, experiments, documents, pictures, tables)
    return {name: document["summary"] for name, document in documents.items()}


def _publish(
    root: Path,
    preset: str,
    experiments: Sequence[Experiment],
    documents: Mapping[str, Mapping[str, Any]],
    pictures: Mapping[str, Figure],
    tables: Mapping[str, str],
) -> None:
    beside = root / page_of(preset).name
    for name, figure in pictures.items():
        save_figure(figure, beside / f"{name}.png")
    for name, document in documents.items():
        write_json(beside / f"{name}.json", document)
        write_text(beside / f"{name}.csv", tables[name])
    write_text(root / page_name(experiments, preset), report(experiments, documents))


def page_name(experiments: Sequence[Experiment], preset: str) -> str:
    """`reproduction.md` for all experiments, `fig3.md` for one: a part does not take the place of the whole."""
    return f"{experiments[0].name}.md" if len(experiments) == 1 else f"{page_of(preset).name}.md"


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        require_writable(folder / "trial")
    except OSError as error:
        raise InvalidInput(f"{folder} cannot be made ({error.strerror}); choose another folder.") from None


def as_csv(rows: Sequence[Row]) -> str:
    """A header and one line per row; what a row lacks stays empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
