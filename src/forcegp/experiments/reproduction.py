"""Run experiments and write what they found: JSON, CSV, figures and one page of Markdown."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from forcegp import __version__
from forcegp.atomic_files import require_writable, write_json, write_text
from forcegp.errors import InvalidInput
from forcegp.evaluation import save_figure
from forcegp.evaluation.summary_statistics import markdown_table
from forcegp.experiments.experiment import Experiment, Row
from forcegp.jobs import JobStore, Progress, run_jobs
from forcegp.parallel import Backend

PAPER_INTRODUCTION = """Rath, Geist and Trimpe, "Using Physics Knowledge for Learning Rigid-body Forward Dynamics with \
Gaussian Process Force Priors" (CoRL 2021), figure by figure, and what goes beyond it. This page, its tables and its \
figures are written by

    {command}

and never by hand; the numbers lie beside it as JSON and CSV. Every pair of training and test trajectory has its own \
way-points and noise, so no test row is a training row. Medians over seeds come with the least and the largest value."""

FORCES_INTRODUCTION = """What priors on forces are worth: data efficiency, friction as it is, other \
contacts, and the parts of the posterior. [forces.md](forces.md) explains the priors. This page, its tables and its \
figures are written by

    {command}

and never by hand; the numbers lie beside it as JSON and CSV. One experiment by its name: `forcegp reproduce NAME \
--preset forces`. Every training and every test trajectory has its own way-points and noise, the noise of the \
acceleration is 0.1 rad/s², “noise-free” errors are against the acceleration without it. Medians over seeds come with \
the least and the largest value."""


@dataclass(frozen=True)
class Page:
    """`name` is that of the file and of the folder beside it; `introduction` holds `{command}`."""

    name: str
    title: str
    introduction: str


PAPER = Page("reproduction", "Reproduction of the paper", PAPER_INTRODUCTION)
FORCES = Page("force-priors", "Force priors: results", FORCES_INTRODUCTION)

TRIAL_PRESETS = ("smoke", "forces-smoke")
"""Presets that test the machinery; their numbers mean nothing for the models."""


def page_of(preset: str) -> Page:
    """The page of the results of that preset."""
    return FORCES if preset.startswith("forces") else PAPER


def report(experiments: Sequence[Experiment], documents: Mapping[str, Mapping[str, Any]]) -> str:
    """Markdown from the documents of the experiments: one section for each, then the times."""
    preset = documents[experiments[0].name]["preset"]
    page = page_of(preset)
    parts = [f"# {page.title}"]
    parts.append(page.introduction.format(command=documents[experiments[0].name]["command"]))
    if preset in TRIAL_PRESETS:
        parts.append(f"**Preset `{preset}`: a test of the machinery. Its numbers mean nothing for the models.**")
    for experiment in experiments:
        document = documents[experiment.name]
        parts.append(f"## {experiment.title}")
        parts += [f"![{experiment.title}]({page.name}/{name}.png)" for name in document["figures"]]
        parts.append(experiment.section(document["summary"]))
        parts += _warnings(document["warnings"])
    seconds = {name: value for document in documents.values() for name, value in document["cpu_seconds"].items()}
    machines = sorted({machine for document in documents.values() for machine in document["machines"]})
    parts += ["## Time", _times(" and ".join(machines), seconds)]
    return "\n\n".join(parts) + "\n"


def _warnings(by_job: Mapping[str, Sequence[str]]) -> list[str]:
    """What the computation warned of, with the number of jobs and one of them; numbers in the text are that one's."""
    kinds: dict[str, list[tuple[str, str]]] = {}
    for job, messages in by_job.items():
        for message in messages:
            kinds.setdefault(re.sub(r"\d[\d.e+-]*", "#", message), []).append((job, message))
    if not kinds:
        return []
    lines = [f"* jobs: {len(found)}, for example `{found[0][0]}`: {found[0][1]}" for found in kinds.values()]
    return ["Warnings while this was computed:\n\n" + "\n".join(lines)]


def _times(machine: str, times: Mapping[str, float]) -> str:
    groups: dict[str, list[float]] = {}
    for name, seconds in times.items():
        kind, *rest = name.split("/")
        group = f"{kind}/{rest[0]}/{rest[-1]}" if kind == "fits" else kind
        groups.setdefault(group, []).append(seconds)
    rows = [[group, str(len(each)), f"{max(each):.0f}", f"{sum(each):.0f}"] for group, each in groups.items()]
    text = (
        f"{sum(times.values()) / 3600:.2f} CPU-hours for {len(times)} jobs, on {machine}. A job includes loading and "
        "scoring, not only the search."
    )
    return f"{text}\n\n{markdown_table(['jobs', 'number', 'longest [CPU s]', 'all [CPU s]'], rows)}"


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
