"""Figure 2b: prediction and constraint error against the number of training points."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from typing_extensions import override

from benchmarks.paper import published
from benchmarks.paper.experiment import Experiment, Row, in_columns, medians
from benchmarks.paper.figures import learning_curves_figure
from benchmarks.paper.fits import (
    ANALYTICAL,
    GAUSSIAN_PROCESSES,
    MODELS,
    FitSettings,
    all_name,
    fit_name,
    fit_series,
    fit_to_all,
)
from forcegp.jobs import Job, JobStore
from forcegp.scores.page import formatted, rendered

SCORES = {
    "mae": "MAE against noisy accelerations [rad/s²]",
    "mae_noise_free": "MAE against noise-free accelerations [rad/s²]",
    "constraint_error": "mean constraint error \\|A a − b\\| [m/s²]",
    "nlpd": "negative log predictive density of a measurement [nats per row]",
    "coverage_95": "share of measurements inside the 95 % interval",
    "cpu_seconds": "CPU seconds of the search of this fit alone, without those that it began from",
}
OF_ALL_ROWS = tuple(SCORES)[:-1]
DIGITS = {"cpu_seconds": 1, "nlpd": 2, "coverage_95": 3}


@dataclass(frozen=True)
class Fig2b(Experiment):
    """Every model on the first N farthest points of `seeds` trajectories; beyond `few_points`, on fewer seeds."""

    name, title = "fig2b", "Figure 2b: error against training points"

    points: tuple[int, ...]
    seeds: tuple[int, ...]
    seeds_many_points: tuple[int, ...]
    few_points: int
    settings: FitSettings
    models: tuple[str, ...] = GAUSSIAN_PROCESSES
    on_all_rows: tuple[str, ...] = ANALYTICAL

    def seeds_of(self, points: int) -> tuple[int, ...]:
        """The seeds of one point of the curve."""
        return self.seeds if points <= self.few_points else self.seeds_many_points

    @override
    def jobs(self) -> list[Job]:
        data = {seed: self.data.job(seed) for seed in sorted({*self.seeds, *self.seeds_many_points})}
        out = list(data.values())
        for model in self.models:
            for seed, job in data.items():
                points = [count for count in self.points if seed in self.seeds_of(count)]
                out += fit_series(model, job.name, seed, points, self.settings)
        for model in self.on_all_rows:
            out += [fit_to_all(model, data[seed].name, seed) for seed in self.seeds_many_points]
        return out

    @override
    def summary(self, results: JobStore) -> dict[str, Any]:
        curves: dict[str, Any] = {}
        for model in self.models:
            curves[model] = {}
            for count in self.points:
                found = [results.result(fit_name(model, count, seed)) for seed in self.seeds_of(count)]
                scores = [{**job["evaluation"], "cpu_seconds": job["search"]["cpu_seconds"]} for job in found]
                counted = {"converged": sum(job["search"]["converged"] for job in found), "seeds": len(found)}
                curves[model][str(count)] = medians(scores, SCORES) | counted
        many = {}
        for model in self.on_all_rows:
            found = [results.result(all_name(model, seed))["evaluation"] for seed in self.seeds_many_points]
            many[model] = medians(found, OF_ALL_ROWS)
        floor = results.result(fit_name(self.models[0], self.points[0], self.seeds[0]))["evaluation"]["noise_floor"]
        return {"curves": curves, "all_rows": {"rows": self.data.rows, "models": many}, "noise_floor": floor}

    @override
    def rows(self, summary: Mapping[str, Any]) -> list[Row]:
        return [
            {"model": MODELS[model].label, "points": int(count), "seeds": scores["seeds"]}
            | {"paper_mae": published.FIG2B_MAE[model].get(int(count)), "converged": scores["converged"]}
            | in_columns({name: scores[name] for name in SCORES})
            for model, curve in summary["curves"].items()
            for count, scores in curve.items()
        ]

    @override
    def figures(self, summary: Mapping[str, Any], results: JobStore) -> dict[str, Figure]:
        return {"fig2b": learning_curves_figure(summary)}

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        tables = []
        for score, heading in SCORES.items():
            rows = []
            for model, curve in summary["curves"].items():
                if score == "mae":
                    cells = [formatted(published.FIG2B_MAE[model].get(int(count))) for count in curve]
                    rows.append([f"{MODELS[model].label}, paper", *cells])
                label = f"**{MODELS[model].label}, ours**" if score == "mae" else MODELS[model].label
                rows.append([label, *(formatted(scores[score], DIGITS.get(score, 4)) for scores in curve.values())])
            tables.append((heading, rows))
        unconverged = [
            f"{MODELS[model].label} N = {count}: {scores['converged']} of {scores['seeds']}"
            for model, curve in summary["curves"].items()
            for count, scores in curve.items()
            if scores["converged"] < scores["seeds"]
        ]
        many = [
            [MODELS[model].label, formatted(published.MAE_10000.get(model), 2)]
            + [formatted(scores[name], DIGITS.get(name, 4)) for name in OF_ALL_ROWS]
            for model, scores in summary["all_rows"]["models"].items()
        ]
        return rendered(
            Path(__file__).with_name("fig2b.md.jinja"),
            **summary,
            seeds=len(self.seeds),
            few_points=self.few_points,
            seeds_many_points=len(self.seeds_many_points),
            searches={count: self.settings.of(count) for count in self.points},
            tables=tables,
            many=many,
            unconverged=unconverged,
        )
