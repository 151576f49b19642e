"""What does conditioning cost against the number of rows, engine by engine?

Viscous friction at the tool of `kuka-surface`, hyper-parameters from 250 rows: a joint prior (7 processes on 21
features) for the exact engine, the prior tool-friction (2 processes on 2) for
inducing points. Rows are spread evenly over one recording. Every case runs in a process of its own on one thread:
conditioning and the mean at 100 states; CPU seconds and the rise of peak memory. The slope is that of the last three
points of log time over log N. Writes docs/benchmarks/performance/scaling.png and scaling.json.

    python -m benchmarks scaling
    python -m benchmarks.scaling exact 400           one case
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch

from benchmarks.large_data import RECORDINGS, in_own_process, peak_bytes, recording
from forcegp import JointForces, ToolForces, fit, load_posterior, save_posterior
from forcegp.atomic_files import write_json
from forcegp.data import farthest_rows
from forcegp.fit.refinement import on_all_rows
from forcegp.inference import ENGINES, Inducing
from forcegp.scores.figures.style import SMALL

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "benchmarks" / "performance"
SEED, SECONDS = 903, 420.0
CASES: dict[str, tuple[int, ...]] = {
    "exact": (100, 200, 400, 800, 1500, 2500),
    "inducing": (100, 1000, 10_000, 100_000),
}
LABELS = {"exact": "exact, joint prior", "inducing": "inducing points, tool-friction prior"}
PRIORS = {"inducing": ToolForces()}


def hyperparameters(engine: str) -> Path:
    """The model that was fitted to 250 rows, made once."""
    prior = PRIORS.get(engine, JointForces())
    folder = RECORDINGS / f"hyper-{prior.title}"
    if not folder.exists():
        data = recording(SEED, SECONDS)
        few = farthest_rows(data.rows(slice(0, None, 50)), 250)
        save_posterior(fit(data.model.with_forces(prior), few, restarts=1), folder)
    return folder


def condition(engine: str, count: int) -> dict[str, Any]:
    """One case, in this process."""
    posterior = load_posterior(hyperparameters(engine))
    data = recording(SEED, SECONDS)
    rows = data.rows(np.linspace(0, len(data) - 1, count).round().astype(int))
    chosen = {"inducing": Inducing()}
    before, cpu = psutil.Process().memory_info().rss, time.process_time()
    conditioned = on_all_rows(posterior, rows, chosen.get(engine, ENGINES[engine]()), {})
    conditioned.predict(rows.q[:100], rows.v[:100], rows.u[:100], covariance=False)
    return {"cpu_s": time.process_time() - cpu, "memory_mib": (peak_bytes() - before) / 2**20}


def slope(counts: list[int], seconds: list[float]) -> float:
    """Of the last three points of log time over log N."""
    return float(np.polyfit(np.log(counts[-3:]), np.log(seconds[-3:]), 1)[0])


def run() -> dict[str, float]:
    """Measure, print and draw; returns the keys of results.json that this question answers."""
    measured: dict[str, dict[int, dict[str, float]]] = {}
    results: dict[str, float] = {}
    print("engine            N    CPU s  memory MiB")
    for engine, counts in CASES.items():
        hyperparameters(engine)  # not in the time of the first case
        measured[engine] = {}
        for count in counts:
            measured[engine][count] = found = in_own_process("benchmarks.scaling", engine, str(count))
            print(f"{engine:10} {count:8d} {found['cpu_s']:8.2f} {found['memory_mib']:11.0f}", flush=True)
        results[f"slope_{engine}"] = slope(list(counts), [found["cpu_s"] for found in measured[engine].values()])
    FOLDER.mkdir(parents=True, exist_ok=True)
    write_json(FOLDER / "scaling.json", measured)
    draw(measured)
    return results


def draw(measured: dict[str, dict[int, dict[str, float]]]) -> None:
    """Time and memory over the number of rows."""
    from forcegp.scores.figures.style import SERIES, new_figure, quiet, save_figure

    figure = new_figure(9.0, 4.0)
    panels = figure.subplots(1, 2)
    quantities = (("cpu_s", "CPU time", "CPU time [s]"), ("memory_mib", "Memory above the data", "peak memory [MiB]"))
    for axes, (key, title, label) in zip(panels, quantities, strict=True):
        for color, (engine, found) in zip(SERIES, measured.items(), strict=False):
            counts, values = list(map(int, found)), [max(entry[key], 1e-2) for entry in found.values()]
            named = f"{LABELS[engine]}: N^{slope(counts, values):.1f}" if key == "cpu_s" else None
            axes.loglog(counts, values, "o-", color=color, markersize=4, linewidth=1.6, label=named)
        quiet(axes, title=title, x="training rows N", y=label)
    figure.legend(fontsize=SMALL, frameon=False, loc="outside lower center", ncols=2)
    save_figure(figure, FOLDER / "scaling.png")


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(condition(sys.argv[1], int(sys.argv[2]))))
