"""What the experiments on force priors share: trials (a model on a scenario), their jobs, and summaries over seeds."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from textwrap import fill
from typing import Any

from matplotlib.figure import Figure
from typing_extensions import override

from benchmarks.paper.data import TEST_SEED
from benchmarks.paper.experiment import Experiment, Row, in_columns, medians
from benchmarks.paper.fits import FitSettings, fit_cost
from forcegp.jobs import Job, JobStore
from forcegp.scores.figures.style import MEASUREMENT, PREDICTION, SMALL, TRUTH, new_figure, plain_ticks, quiet
from forcegp.scores.tables import formatted, markdown_table, median_and_range

_SCENARIOS: dict[str, tuple[str, dict[str, Any]]] = {
    "viscous": ("viscous tool friction (the paper's)", {}),
    "coulomb": ("Coulomb friction at the tool, proportional to the load", {"friction": "coulomb"}),
    "stribeck": ("Stribeck friction at the tool, proportional to the load", {"friction": "stribeck"}),
    "viscous-joints": ("viscous at the tool, Stribeck in the joints", {"joint_friction": "stribeck"}),
    "stribeck-joints": (
        "Stribeck at the tool (load) and in the joints",
        {"friction": "stribeck", "joint_friction": "stribeck"},
    ),
    "tilted": ("tilted plane", {"surface": "tilted"}),
    "sphere": ("sphere", {"surface": "sphere"}),
    "tilted-joints": ("tilted plane", {"surface": "tilted", "joint_friction": "stribeck"}),
    "sphere-joints": ("sphere", {"surface": "sphere", "joint_friction": "stribeck"}),
    "free-joints": ("free motion", {"surface": "none", "joint_friction": "stribeck"}),
    **{
        f"{law}-joints": (label, {"surface": "none", "joint_friction": law})
        for law, label in {
            "exponential": "exponential Stribeck friction",
            "asymmetric": "another dry friction backwards, hard sign",
            "load": "dry friction that grows with the torque, more where it drives",
            "lugre": "bristles that yield before they slide (LuGre)",
            "drift": "dry friction that falls by 30 % as the gears warm up",
        }.items()
    },
}
SCENARIOS = {name: fields for name, (_, fields) in _SCENARIOS.items()}
"""Name -> fields of `KukaSurfaceConfig`."""

LABELS = {name: label for name, (label, _) in _SCENARIOS.items()}  # what pages call them
TASKS, CODE = "benchmarks.force_priors.jobs", ("benchmarks.paper.fits",)


@dataclass(frozen=True)
class Trial:
    """One model on one scenario.

    prior: expression of `forcegp.forces.parse_forces`, or a model of `benchmarks.force_priors.jobs`
    tests: label -> scenario that the model is scored on, under that scenario's contacts
    region: train at tool x < 0, test at x > 0.1 m
    """

    label: str
    scenario: str
    prior: str
    points: int
    tests: Mapping[str, str] = field(default_factory=dict)
    mean: str = "analytical"
    region: bool = False

    @property
    def tested_on(self) -> Mapping[str, str]:
        """`tests`, or the own scenario where there are none."""
        return self.tests or {self.scenario: self.scenario}

    @property
    def name(self) -> str:
        """Unique among the trials of all experiments with the same data."""
        place = "-extrapolation" if self.region else ""
        prior = self.prior.replace("/", "-").replace(" ", "").replace("gp:", "").replace(",", "+")
        tested = "-".join(sorted({scenario for scenario in self.tests.values() if scenario != self.scenario}))
        return f"{self.scenario}{place}/{prior}-{self.mean}{f'-on-{tested}' if tested else ''}/n{self.points}"


@dataclass(frozen=True)
class ForceExperiment(Experiment):
    """Trials on seeds; a subclass defines the trials and describes the results."""

    points: tuple[int, ...]
    seeds: tuple[int, ...]
    settings: FitSettings

    @abstractmethod
    def trials(self) -> list[Trial]:
        """Every model on every scenario."""

    @override
    def jobs(self) -> list[Job]:
        out: dict[str, Job] = {}
        for seed in self.seeds:
            for trial in self.trials():
                train = self.data_job(trial.scenario, seed, training=True)
                tests = {label: self.data_job(name, seed, training=False) for label, name in trial.tested_on.items()}
                spec = {
                    "train": train.name,
                    "tests": {label: job.name for label, job in tests.items()},
                    **{name: getattr(trial, name) for name in ("prior", "mean", "points", "region")},
                    "seed": seed,
                    **self.settings.of(trial.points),
                }
                after = (train.name, *(job.name for job in tests.values()))
                cost = 0.3 * fit_cost("s-gp", trial.points, spec)
                fit = Job(trial_name(trial, seed), f"{TASKS}:fit", spec, after, cost, code=CODE)
                for job in (train, *tests.values(), fit):
                    out[job.name] = job
        return list(out.values())

    @override
    def summary(self, results: JobStore) -> dict[str, Any]:
        return {"points": list(self.points), "trials": [self._summarized(results, trial) for trial in self.trials()]}

    def _summarized(self, results: JobStore, trial: Trial) -> dict[str, Any]:
        found = [results.result(trial_name(trial, seed)) for seed in self.seeds]
        tests = {}
        for label in trial.tested_on:
            names = dict.fromkeys(name for job in found for name in job["tests"][label])
            tests[label] = medians([job["tests"][label] for job in found], names)
        coverages = [[curve["coverage"] for curve in job["curves"].values()] for job in found]
        return {
            **{name: getattr(trial, name) for name in ("label", "scenario", "prior", "points", "region")},
            "tests": tests,
            "curve_coverage": median_and_range(chain.from_iterable(coverages)),
            "curve_coverage_of_seeds": median_and_range(sum(each) / len(each) for each in coverages if each),
            "search_seconds": median_and_range(job["search"]["cpu_seconds"] for job in found),
        }

    @override
    def rows(self, summary: Mapping[str, Any]) -> list[Row]:
        return [
            {key: trial[key] for key in ("label", "scenario", "prior", "points")}
            | {"extrapolation": int(trial["region"]), "tested_on": label}
            | in_columns(scores)
            for trial in summary["trials"]
            for label, scores in trial["tests"].items()
        ]

    def data_job(self, scenario: str, seed: int, *, training: bool) -> Job:
        """The trajectory of that scenario and seed."""
        spec = {
            "scenario": dict(SCENARIOS[scenario]),
            "seed": seed if training else TEST_SEED + seed,
            "seconds": self.data.train_seconds if training else self.data.test_seconds,
            "rows": self.data.rows if training else None,
            "every": self.data.every,
        }
        kind = "train" if training else "test"
        name, cost = f"force-data/{scenario}/{kind}/seed{seed}", 0.15 * spec["seconds"]
        return Job(name, f"{TASKS}:simulate", spec, cost=cost, code=CODE)


trial_name = "force-fits/{0.name}/seed{1}".format  # where the job of a trial and a seed lies


COLUMNS = {
    "mae": ("MAE", 4),
    "mae_noise_free": ("MAE noise-free", 4),
    "nlpd": ("NLPD", 2),
    "coverage_95": ("in 95 % band", 3),
    "coverage_95_noise_free": ("truth in 95 % band", 3),
    "normal_force_error": ("normal force, relative RMSE", 4),
    "normal_force_coverage": ("normal force in 95 % band", 3),
    "component_sum_error": ("sum of components [Nm]", 4),
}
"""Score -> heading and decimals."""


def score_table(trials: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> str:
    """One row per trial and test, medians and ranges over seeds."""
    head = ["model", "points", *(COLUMNS[name][0] for name in columns)]
    rows = [
        [trial["label"], str(trial["points"]), *(formatted(scores.get(name), COLUMNS[name][1]) for name in columns)]
        for trial in trials
        for scores in trial["tests"].values()
    ]
    return markdown_table(head, rows)


def trials_on(scenario: str, summary: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The trials of a summary that were trained on that scenario."""
    return [trial for trial in summary["trials"] if trial["scenario"] == scenario]


def only_test(trial: Mapping[str, Any]) -> Mapping[str, Any]:
    """The scores of a trial that was tested on one scenario."""
    (scores,) = trial["tests"].values()
    return scores


def dots_figure(groups: Mapping[str, Mapping[str, Mapping[str, Any]]], score: str, label: str) -> Figure:
    """Group -> model -> scores: one panel per group, a dot per model at the median, the range over seeds as a line.

    The first model of a group is what the others are compared with, and grey.
    """
    figure = new_figure(4.8 * len(groups), 0.32 * max(len(scores) for scores in groups.values()) + 1.3)
    panels = figure.subplots(1, len(groups), squeeze=False)[0]
    for axes, (group, scores) in zip(panels, groups.items(), strict=True):
        for place, model in enumerate(scores):
            value, color = scores[model][score], PREDICTION if place else MEASUREMENT
            axes.plot([value["min"], value["max"]], [place, place], color=color, linewidth=3.0, alpha=0.45)
            axes.plot(value["median"], place, "o", color=color, markersize=6.0)
            text = f"{value['median']:.3g}"
            beside = (value["max"], place)
            axes.annotate(text, beside, (7, 0), textcoords="offset points", va="center", fontsize=SMALL, color=TRUTH)
        axes.set_yticks(range(len(scores)), list(scores))
        axes.set_ylim(len(scores) - 0.5, -0.5)
        axes.set_xscale("log")
        lowest = min(values[score]["min"] for values in scores.values())
        highest = max(values[score]["max"] for values in scores.values())
        axes.set_xlim(0.6 * lowest, 2.5 * highest)
        plain_ticks(axes.xaxis)
        quiet(axes, title=fill(group, 44), x=label)
    return figure


def heading(label: str) -> str:
    """In bold, with a capital letter."""
    return f"**{label[0].upper()}{label[1:]}**"
