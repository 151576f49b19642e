"""What do the searches for hyper-parameters cost, and where do they end?

100 rows of `kuka-surface` that lie farthest apart, five recordings, for every Gaussian process of figure 2b and for
priors on friction: evaluations of the objective in a fit with all its defaults (four starts), and where it ended. To
compare with another version, run this file with PYTHONPATH at the sources of that version, and give its lines:

    python -m benchmarks searches
    python -m benchmarks.searches > now.txt; PYTHONPATH=OTHER/src python -m benchmarks.searches now.txt
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmarks.large_data import recording
from benchmarks.paper.fits import GAUSSIAN_PROCESSES, MODELS
from forcegp import Dataset
from forcegp.data import farthest_rows
from forcegp.fit import fit
from forcegp.forces import parse_forces

SEEDS = (11, 12, 13, 14, 15)
SECONDS = 60.0
POINTS = 100
COULOMB = {"joint_friction": "coulomb"}
LOAD = {**COULOMB, "friction": "coulomb"}
FRICTION = {
    "gp:tool-friction": {},
    "gp:joint-friction": COULOMB,
    "gp:joint-friction,gp:load-friction:expected=0.3": LOAD,
}


def model_of(name: str, data: Dataset) -> Callable[..., object]:
    """The `fit` of a model of figure 2b, or with a prior."""
    assert data.model is not None
    if name in MODELS:
        model = MODELS[name].make(data.model)
    else:
        model = data.model.with_forces(parse_forces(name))
    return partial(fit, model)


def measured() -> dict[tuple[str, int], tuple[int, float]]:
    """Evaluations and the final objective of every model and seed."""
    found: dict[tuple[str, int], tuple[int, float]] = {}
    for name in (*GAUSSIAN_PROCESSES, *FRICTION):
        for seed in SEEDS:
            data = farthest_rows(recording(seed, SECONDS, **FRICTION.get(name, {})), POINTS)
            search = model_of(name, data)(data).result  # type: ignore[attr-defined]  # every posterior of these has one
            found[name, seed] = search.evaluations, search.value
            print(f"{name:42} {seed} {search.evaluations:6d} {search.value:12.3f}  {search.status}", flush=True)
    return found


def run() -> dict[str, float]:
    """Measure and print; returns the keys of results.json that this question answers."""
    found = measured()
    medians = {}
    for name in (*GAUSSIAN_PROCESSES, *FRICTION):
        medians[name] = statistics.median(found[name, seed][0] for seed in SEEDS)
        print(f"{name:42} median {medians[name]:6.0f} evaluations")
    return {"search_evaluations_n100": max(medians[name] for name in ("s-gp-38", "s-gp", "s-gp-mean"))}


def compare(earlier: Path) -> None:
    """Print how each line of an earlier output differs from what this version does."""
    lines = [line.split() for line in earlier.read_text().splitlines() if "median" not in line]
    other = {(name, int(seed)): (int(count), float(value)) for name, seed, count, value, *_ in lines}
    for key, (count, value) in measured().items():
        print(f"{key}: evaluations {other[key][0]} / {count}, objective {other[key][1] - value:+.3f} nats", flush=True)


if __name__ == "__main__":
    import torch

    torch.set_num_threads(1)
    compare(Path(sys.argv[1])) if len(sys.argv) > 1 else run()
