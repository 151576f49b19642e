"""What the experiments on force priors share: trials (a model on a scenario), their jobs, and summaries over seeds."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from typing_extensions import override

from forcegp.evaluation.summary_statistics import in_columns, median_and_range, medians
from forcegp.experiments.experiment import DataSettings, Experiment, Row
from forcegp.experiments.fits import FitSettings, fit_cost
from forcegp.experiments.force_scenarios import SCENARIOS
from forcegp.jobs import Job, JobStore

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

    data: DataSettings
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
