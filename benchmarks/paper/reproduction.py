"""The presets: experiments with all their settings; run them, and write JSON, CSV, figures and one page of Markdown."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.paper.experiment import DataSettings, Experiment, Row
from benchmarks.paper.fig2b import Fig2b
from benchmarks.paper.fig2c import Fig2c
from benchmarks.paper.fig3 import Fig3
from benchmarks.paper.fig4 import Fig4
from benchmarks.paper.fits import FitSettings
from forcegp import __version__
from forcegp.atomic_files import require_writable, write_json, write_text
from forcegp.errors import InvalidInput, require_known
from forcegp.jobs import JobStore, run_jobs
from forcegp.parallel import Jobs
from forcegp.scores import save_figure
from forcegp.scores.page import markdown_table
from forcegp.scores.scores import alike

PAPER_DATA = DataSettings(train_seconds=200.0, rows=10_000, test_seconds=100.0, every=12)
SMOKE_DATA = DataSettings(train_seconds=10.0, rows=400, test_seconds=12.0, every=12)

PAPER_SEARCH = FitSettings(restarts={"0": 4, "200": 2, "400": 1}, iterations=200, tolerance={"0": 1e-6, "1000": 1e-5})
SMOKE_SEARCH = FitSettings(restarts={"0": 1}, iterations=15, tolerance={"0": 1e-6})

# Seeds that served no choice made elsewhere in this project.
PAPER_SEEDS = (101, 102, 103, 104, 105)

PAPER_POINTS = (100, 200, 400, 600, 800, 1000)
SMOKE_POINTS = (20, 40)

PAPER: dict[str, Any] = {"data": PAPER_DATA, "settings": PAPER_SEARCH}
SMOKE: dict[str, Any] = {"data": SMOKE_DATA, "settings": SMOKE_SEARCH, "seeds": (101,)}

PRESETS: dict[str, tuple[Experiment, ...]] = {
    "paper": (
        Fig2b(points=PAPER_POINTS, seeds=PAPER_SEEDS, seeds_many_points=PAPER_SEEDS[:2], few_points=400, **PAPER),
        Fig2c(PAPER_DATA, 100, tuple(range(101, 104)), iterations=150, tolerance=1e-7),
        Fig3(points=PAPER_POINTS[:1], seed=101, start=5.0, seconds=3.0, **PAPER),
        Fig4(points=PAPER_POINTS, seeds=PAPER_SEEDS[:2], starts=10, seconds=(1.0, 5.0), **PAPER),
    ),
    "smoke": (
        Fig2b(points=SMOKE_POINTS, seeds_many_points=(101,), few_points=SMOKE_POINTS[-1], **SMOKE),
        Fig2c(SMOKE_DATA, 30, (101,), iterations=8, tolerance=1e-6),
        Fig3(SMOKE_DATA, SMOKE_POINTS, 101, start=1.0, seconds=1.0, settings=SMOKE_SEARCH),
        Fig4(points=SMOKE_POINTS, starts=2, seconds=(0.1, 0.2), **SMOKE),
    ),
}

ALL = "all"


def experiments_of(
    preset: str,
    figure: str,
) -> tuple[Experiment, ...]:
    """One experiment of a preset by name, or all. Raises InvalidInput for unknown names."""
    require_known("preset", preset, PROGRAM, PRESETS)
    experiments = {experiment.name: experiment for experiment in PRESETS[preset]}
    if figure == ALL:
        return tuple(experiments.values())
    require_known("figure", figure, PROGRAM, [*experiments, ALL])
    return (experiments[figure],)


PAPER_INTRODUCTION = """Rath, Geist and Trimpe, "Using Physics Knowledge for Learning Rigid-body Forward Dynamics with \
Gaussian Process Force Priors" (CoRL 2021), figure by figure, and what goes beyond it. This page, its tables and its \
figures are written by

    {command}

and never by hand; the numbers lie beside it as JSON and CSV. Every pair of training and test trajectory has its own \
way-points and noise, so no test row is a training row. Medians over seeds come with the least and the largest value."""


PROGRAM, NAME = "python -m benchmarks.paper", "reproduction"
"""The command that writes the page, and the name of its file and of the folder beside it."""
TRIAL = "smoke"  # the preset that tests the machinery; its numbers mean nothing for the models


def page_of(experiments: Sequence[Experiment]) -> str:
    """`reproduction.md` for all experiments, `fig3.md` for one: a part does not take the place of the whole."""
    return f"{experiments[0].name}.md" if len(experiments) == 1 else f"{NAME}.md"


def report(experiments: Sequence[Experiment], documents: Mapping[str, Mapping[str, Any]]) -> str:
    """Markdown from the documents of the experiments: one section for each, then the times."""
    preset = documents[experiments[0].name]["preset"]
    parts = [
        "# Reproduction of the paper",
        PAPER_INTRODUCTION.format(command=documents[experiments[0].name]["command"]),
    ]
    if preset == TRIAL:
        parts.append(f"**Preset `{preset}`: a test of the machinery. Its numbers mean nothing for the models.**")
    for experiment in experiments:
        document = documents[experiment.name]
        parts.append(f"## {experiment.title}")
        parts += [f"![{experiment.title}]({NAME}/{name}.png)" for name in document["figures"]]
        parts.append(experiment.section(document["summary"]).strip())
        told = [(text, job) for job, texts in document["warnings"].items() for text in texts]
        lines = [f"* jobs: {len(found)}, for example `{found[0][1]}`: {found[0][0]}" for found in alike(told)]
        parts += ["Warnings while this was computed:\n\n" + "\n".join(lines)] if lines else []
    seconds = {name: value for document in documents.values() for name, value in document["cpu_seconds"].items()}
    machines = sorted({machine for document in documents.values() for machine in document["machines"]})
    parts += ["## Time", _times(" and ".join(machines), seconds)]
    return "\n\n".join(parts) + "\n"


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


def reproduce(
    experiments: Sequence[Experiment],
    preset: str,
    out: Path,
    *,
    command: str,
    docs: Path | None = None,
    jobs: Jobs = 1,
) -> dict[str, Any]:
    """Compute what is missing in the folder `out`, then write all summaries; returns them by experiment.

    Writes the page (`page_of`) and, in the folder of its name, `<name>.json`, `<name>.csv` and the figures as PNG,
    into `out` and, if given, into `docs`, too. `command` is the command that the page names as its
    source. Raises InvalidInput for experiments that the data do not allow and for folders that cannot be written, and
    as `JobStore.open` and `run_jobs`.
    """
    for experiment in experiments:
        experiment.require_possible()
    results = JobStore.open(out, PROGRAM, {"preset": preset})
    roots = (out,) if docs is None else (out, docs)
    for folder in (root / NAME for root in roots):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            require_writable(folder / "trial")
        except OSError as error:
            raise InvalidInput(f"{folder} cannot be made ({error.strerror}); choose another folder.") from None
    pieces = {job.name: job for experiment in experiments for job in experiment.jobs()}
    run_jobs(results, list(pieces.values()), jobs)
    documents, pictures = {}, {}
    for experiment in experiments:
        summary = experiment.summary(results)
        figures = experiment.figures(summary, results)
        pictures |= figures
        stored = {job.name: results.load(job.name) for job in experiment.jobs()}
        documents[experiment.name] = {
            "kind": PROGRAM,
            "forcegp_version": __version__,
            "preset": preset,
            "command": command,
            "config": asdict(experiment),
            "figures": list(figures),
            "machines": sorted({job["machine"] for job in stored.values()}),
            "cpu_seconds": {name: job["cpu_seconds"] for name, job in stored.items()},
            "warnings": {name: job["warnings"] for name, job in stored.items() if job["warnings"]},
            "summary": summary,
        }
    for root in roots:
        beside = root / NAME
        for name, figure in pictures.items():
            save_figure(figure, beside / f"{name}.png")
        for experiment in experiments:
            document = documents[experiment.name]
            write_json(beside / f"{experiment.name}.json", document)
            write_text(beside / f"{experiment.name}.csv", as_csv(experiment.rows(document["summary"])))
        write_text(root / page_of(experiments), report(experiments, documents))
    return {name: document["summary"] for name, document in documents.items()}


def as_csv(rows: Sequence[Row]) -> str:
    """A header and one line per row; what a row lacks stays empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
