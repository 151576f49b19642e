"""Run experiments and write what they found: JSON, CSV, figures and one page of Markdown."""

from __future__ import annotations

import csv
import io
import json
import os
import platform
import secrets
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from forcegp import __version__
from forcegp.errors import FileFormatError
from forcegp.evaluation import save_figure
from forcegp.experiments.cells import Progress, run_cells
from forcegp.experiments.experiment import Experiment, Row
from forcegp.experiments.report import report
from forcegp.experiments.results import KIND, Results, write_json, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE, BESIDE = "reproduction.md", "reproduction"
"""The page, and the folder beside it with its figures, JSON and CSV."""

LIBRARIES = ("torch", "gpytorch", "scipy", "numpy", "pybullet")


def reproduce(
    experiments: Sequence[Experiment],
    preset: str,
    out: Path,
    *,
    docs: Path | None = None,
    jobs: int = 1,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compute what is missing in the folder `out`, then write all summaries; returns them by experiment.

    Writes `reproduction.md` and, in `reproduction/`, `<name>.json`, `<name>.csv` and the figures as PNG and SVG, into
    `out` and, if given, into `docs`, too. Raises as `Results.open` and `run_cells`.
    """
    for experiment in experiments:
        experiment.require_possible()
    results = Results.open(out, preset)
    cells = {cell.name: cell for experiment in experiments for cell in experiment.cells()}
    run_cells(results, list(cells.values()), jobs, progress)
    documents, pictures, tables = {}, {}, {}
    for experiment in experiments:
        summary = experiment.summary(results)
        figures = experiment.figures(summary, results)
        documents[experiment.name] = {
            "kind": KIND,
            "forcegp_version": __version__,
            "preset": preset,
            "config": experiment.config(),
            "machine": machine(),
            "figures": list(figures),
            "cpu_seconds": {cell.name: results.load(cell.name)["cpu_seconds"] for cell in experiment.cells()},
            "summary": summary,
        }
        pictures |= figures
        tables[experiment.name] = as_csv(experiment.rows(summary))
    for root in (out, docs) if docs is not None else (out,):
        _publish(root, experiments, documents, pictures, tables)
    return {name: document["summary"] for name, document in documents.items()}


def _publish(
    root: Path,
    experiments: Sequence[Experiment],
    documents: Mapping[str, Mapping[str, Any]],
    pictures: Mapping[str, Figure],
    tables: Mapping[str, str],
) -> None:
    beside = root / BESIDE
    beside.mkdir(parents=True, exist_ok=True)
    for name, figure in pictures.items():
        save_figure(figure, beside / f"{name}.png")
        save_vector(figure, beside / f"{name}.svg")
    for name, document in documents.items():
        write_json(beside / f"{name}.json", document)
        write_text(beside / f"{name}.csv", tables[name])
    write_text(root / PAGE, report(experiments, documents, BESIDE))


def read_document(file: Path) -> dict[str, Any]:
    """A `<name>.json` that `reproduce` wrote. Raises FileFormatError for anything else."""
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{file} cannot be read: {error}") from None
    if not isinstance(document, dict) or document.get("kind") != KIND:
        raise FileFormatError(f"{file} was not written by `{KIND}`.")
    return document


def machine() -> str:
    """Processor, cores and the versions that decide the numbers."""
    model = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else ():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    versions = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    return f"{model}, {os.cpu_count()} cores; Python {platform.python_version()}, {versions}"


def as_csv(rows: Sequence[Row]) -> str:
    """A header and one line per row; what a row lacks stays empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def save_vector(figure: Figure, path: Path) -> None:
    """SVG under a temporary name, then renamed; equal figures give equal files."""
    import matplotlib as mpl

    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")
    try:
        with mpl.rc_context({"svg.hashsalt": "forcegp"}):
            figure.savefig(temporary, format="svg", metadata={"Date": None})
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
