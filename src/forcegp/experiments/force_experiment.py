"""What the experiments on force priors share: trials (a model on a scenario), their jobs, and summaries over seeds."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from textwrap import fill
from types import MappingProxyType
from typing import Any

from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from typing_extensions import override

from forcegp.evaluation.metrics import formatted, in_columns, markdown_table, median_and_range, medians
from forcegp.evaluation.plots.style import MEASUREMENT, PREDICTION, SMALL, TRUTH, new_figure, quiet
from forcegp.experiments.experiment import Experiment, Row
from forcegp.experiments.fits import FitSettings, fit_cost
from forcegp.jobs import Job, JobStore

SCENARIOS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "viscous": {},
        "coulomb": {"friction": "coulomb"},
        "stribeck": {"friction": "stribeck"},
        "viscous-joints": {"joint_friction": "stribeck"},
        "stribeck-joints": {"friction": "stribeck", "joint_friction": "stribeck"},
        "tilted": {"surface": "tilted"},
        "sphere": {"surface": "sphere"},
        "tilted-joints": {"surface": "tilted", "joint_friction": "stribeck"},
        "sphere-joints": {"surface": "sphere", "joint_friction": "stribeck"},
        "free-joints": {"surface": "none", "joint_friction": "stribeck"},
        "bullet": {"contact": "bullet"},
        "patch": {"patch_factor": 4.0},
    }
)
"""Name -> fields of `KukaSurfaceConfig`."""

LABELS = {
    "viscous": "viscous tool friction (the paper's)",
    "coulomb": "Coulomb friction at the tool, proportional to the load",
    "stribeck": "Stribeck friction at the tool, proportional to the load",
    "viscous-joints": "viscous at the tool, Stribeck in the joints",
    "stribeck-joints": "Stribeck at the tool (load) and in the joints",
    "tilted": "tilted plane",
    "sphere": "sphere",
    "tilted-joints": "tilted plane",
    "sphere-joints": "sphere",
    "free-joints": "free motion",
    "bullet": "PyBullet's unilateral contact",
    "patch": "viscous, four times as much on a strip",
}
"""What pages call them."""


TASKS = "forcegp.experiments.force_jobs"
TEST_SEED = 1000
"""The test trajectory of seed k has seed k + 1000."""


@dataclass(frozen=True)
class Trial:
    """One model on one scenario.

    prior: expression of `forcegp.priors.named_prior`, or a model of `force_jobs`; tests: label -> scenario that the
    model is scored on, under that scenario's contacts; region: train at tool x < 0, test at x > 0.1 m.
    """

    label: str
    scenario: str
    prior: str
    points: int
    tests: Mapping[str, str] = field(default_factory=dict)
    mean: str = "analytical"
    region: bool = False

    @property
    def name(self) -> str:
        """Unique among the trials of all experiments with the same data."""
        place = "-extrapolation" if self.region else ""
        prior = self.prior.replace("/", "-").replace(" ", "")
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
                tests = {label: self.data_job(name, seed, training=False) for label, name in self._tests(trial).items()}
                spec = {
                    "train": train.name,
                    "tests": {label: job.name for label, job in tests.items()},
                    **{name: getattr(trial, name) for name in ("prior", "mean", "points", "region")},
                    "seed": seed,
                    **self.settings.of(trial.points),
                }
                after = (train.name, *(job.name for job in tests.values()))
                cost = 0.3 * fit_cost("s-gp", trial.points, spec)
                for job in (train, *tests.values(), Job(trial_name(trial, seed), f"{TASKS}:fit", spec, after, cost)):
                    out[job.name] = job
        return list(out.values())

    @override
    def summary(self, results: JobStore) -> dict[str, Any]:
        return {"points": list(self.points), "trials": [self._summarized(results, trial) for trial in self.trials()]}

    def _summarized(self, results: JobStore, trial: Trial) -> dict[str, Any]:
        found = [results.result(trial_name(trial, seed)) for seed in self.seeds]
        tests = {}
        for label in self._tests(trial):
            names = dict.fromkeys(name for job in found for name in job["tests"][label])
            tests[label] = medians([job["tests"][label] for job in found], names)
        coverages = [curve["coverage"] for job in found for curve in job["curves"].values()]
        return {
            **{name: getattr(trial, name) for name in ("label", "scenario", "prior", "points", "region")},
            "tests": tests,
            "curve_coverage": median_and_range(coverages),
            "curve_coverage_of_seeds": median_and_range(
                _mean([curve["coverage"] for curve in job["curves"].values()]) for job in found if job["curves"]
            ),
            "leave_one_out": median_and_range(job["leave_one_out"] for job in found),
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

    def _tests(self, trial: Trial) -> Mapping[str, str]:
        return trial.tests or {trial.scenario: trial.scenario}

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
        return Job(f"force-data/{scenario}/{kind}/seed{seed}", f"{TASKS}:simulate", spec, cost=0.15 * spec["seconds"])


def trial_name(trial: Trial, seed: int) -> str:
    """Where the job of a trial lies."""
    return f"force-fits/{trial.name}/seed{seed}"


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


COLUMNS = {
    "mae": ("MAE", 4),
    "mae_noise_free": ("MAE noise-free", 4),
    "nlpd": ("NLPD", 2),
    "coverage_95": ("in 95 % band", 3),
    "normal_force_error": ("normal force, relative RMSE", 4),
    "normal_force_coverage": ("normal force in 95 % band", 3),
    "component_sum_error": ("sum of components [Nm]", 4),
    "mae_touching": ("MAE touching", 4),
    "mae_in_the_air": ("MAE in the air", 4),
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


def plain_ticks(axis: Axis) -> None:
    """Numbers such as 0.02 and 50 at 1, 2 and 5 times powers of ten of a logarithmic axis."""
    low, high = axis.get_view_interval()
    steps = (1.0, 2.0, 5.0) if high < 80.0 * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=steps))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
