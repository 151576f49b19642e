"""The experiments with all their settings, and the page that they are published on."""

from __future__ import annotations

from typing import Any

from benchmarks.force_priors.experiments import DataEfficiency, Friction, OtherLaws, Transfer
from benchmarks.force_priors.trials import ForceExperiment
from benchmarks.paper.experiment import DataSettings
from benchmarks.paper.fits import FitSettings
from benchmarks.paper.reproduction import TRIAL, Page

SEEDS = (301, 302, 303, 304, 305)  # served no choice of a prior or kernel
DATA = DataSettings(train_seconds=60.0, rows=400, test_seconds=60.0, every=4)
SEARCH = FitSettings(restarts={"0": 4, "200": 2, "400": 1}, iterations=200, tolerance={"0": 1e-6, "1000": 1e-5})
FORCES: dict[str, Any] = {"data": DATA, "settings": SEARCH, "seeds": SEEDS}

SMALL_DATA = DataSettings(train_seconds=5.0, rows=200, test_seconds=5.0, every=12)
SMALL_SEARCH = FitSettings(restarts={"0": 1}, iterations=15, tolerance={"0": 1e-6})
SMALL: dict[str, Any] = {"data": SMALL_DATA, "settings": SMALL_SEARCH, "seeds": (201,)}

PRESETS: dict[str, tuple[ForceExperiment, ...]] = {
    "forces": (
        DataEfficiency(points=(10, 20, 50, 100), **FORCES),
        Friction(points=(200,), **FORCES),
        OtherLaws(points=(200,), **{**FORCES, "seeds": SEEDS[:3]}),
        Transfer(points=(100,), **FORCES),
    ),
    TRIAL: (
        DataEfficiency(points=(10, 20), region_points=20, **SMALL),
        *(kind(points=(20,), **SMALL) for kind in (Friction, OtherLaws, Transfer)),
    ),
}

INTRODUCTION = """What priors on forces are worth: data efficiency, friction as it is, other contacts, and the parts \
of the posterior. [forces.md](../how-to/forces.md) explains the priors. This page, its tables and its \
figures are written by

    {command}

and never by hand; the numbers lie beside it as JSON and CSV. One experiment by its name: \
`python -m benchmarks.force_priors NAME`. Every training and every test trajectory has its own way-points and noise, \
the noise of the acceleration is 0.1 rad/s², “noise-free” errors are against the acceleration without it. Medians over \
seeds come with the least and the largest value."""

PAGE = Page("python -m benchmarks.force_priors", "force-priors", "Force priors: results", INTRODUCTION)
