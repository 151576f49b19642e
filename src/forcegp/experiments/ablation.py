"""What the paper leaves unclear, and what each of it does to the numbers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import override

from forcegp.evaluation.metrics import formatted, in_columns, markdown_table, medians
from forcegp.experiments import published
from forcegp.experiments.ablation_jobs import PAPER_STEPS, SCHEDULES
from forcegp.experiments.experiment import Experiment, Row
from forcegp.experiments.fits import GAUSSIAN_PROCESSES, MODELS, FitSettings, fit_cost, fit_name, fit_series
from forcegp.jobs import Job, JobStore

TASKS = "forcegp.experiments.ablation_jobs"
OURS = "ours"
FILTERED_MODELS = ("s-gp-mean",)
OVERLAP_MODELS = ("gp", "s-gp-mean")


@dataclass(frozen=True)
class Ablation(Experiment):
    """Schedules of the search at `points[-1]` points, a low-pass filter, and test rows among the training rows."""

    name: ClassVar[str] = "ablation"
    title: ClassVar[str] = "What the paper leaves unclear, measured"

    points: tuple[int, ...]
    seeds: tuple[int, ...]
    settings: FitSettings
    cutoffs: tuple[float, ...]
    steps: int = PAPER_STEPS

    @property
    def largest(self) -> int:
        """The number of points that everything here is measured at."""
        return max(self.points)

    @override
    def jobs(self) -> list[Job]:
        out: list[Job] = []
        tolerance = self.settings.of(self.largest)["tolerance"]
        shared = {"points": self.largest, "iterations": self.settings.iterations, "tolerance": tolerance}
        for seed in self.seeds:
            data = self.data.job(seed)
            out.append(data)
            base = {**shared, "data": data.name, "seed": seed}
            for model in GAUSSIAN_PROCESSES:
                series = fit_series(model, data.name, seed, list(self.points), self.settings)
                out += series
                for schedule in SCHEDULES:
                    spec = {**base, "model": model, "schedule": schedule, "steps": self.steps}
                    cost = fit_cost(model, self.largest, {"restarts": 4, "iterations": self.settings.iterations})
                    out.append(Job(_schedule_name(model, schedule, seed), f"{TASKS}:search", spec, (data.name,), cost))
            for model in FILTERED_MODELS:
                for cutoff in (None, *self.cutoffs):
                    spec = {**base, "model": model, "cutoff": cutoff, "train_seconds": self.data.train_seconds}
                    cost = 15.0 + fit_cost(model, self.largest, {"restarts": 1, "iterations": self.settings.iterations})
                    out.append(Job(_filter_name(model, cutoff, seed), f"{TASKS}:filtered", spec, (data.name,), cost))
            for model in OVERLAP_MODELS:
                fit = fit_name(model, self.largest, seed)
                spec = {"fit": fit, "data": data.name, "seed": seed, "train_seconds": self.data.train_seconds}
                out.append(Job(_overlap_name(model, seed), f"{TASKS}:overlap", spec, (fit,), 20.0))
        return out

    @override
    def summary(self, results: JobStore) -> dict[str, Any]:
        schedules: dict[str, Any] = {}
        for model in GAUSSIAN_PROCESSES:
            found = {OURS: [results.result(fit_name(model, self.largest, seed)) for seed in self.seeds]}
            for schedule in SCHEDULES:
                found[schedule] = [results.result(_schedule_name(model, schedule, seed)) for seed in self.seeds]
            schedules[model] = {name: self._scores(jobs) for name, jobs in found.items()}
        filters = {
            model: {
                "none" if cutoff is None else f"{cutoff:g}": self._scores(
                    [results.result(_filter_name(model, cutoff, seed)) for seed in self.seeds]
                )
                for cutoff in (None, *self.cutoffs)
            }
            for model in FILTERED_MODELS
        }
        overlap = {}
        for model in OVERLAP_MODELS:
            jobs = [results.result(_overlap_name(model, seed)) for seed in self.seeds]
            fits = [results.result(fit_name(model, self.largest, seed))["evaluation"] for seed in self.seeds]
            other = medians(fits, ("mae", "mae_noise_free"))
            overlap[model] = medians(jobs, ("mae", "mae_noise_free", "shared"))
            overlap[model] |= {f"{name}_other": each for name, each in other.items()}
        return {"points": self.largest, "schedules": schedules, "filters": filters, "overlap": overlap}

    @staticmethod
    def _scores(jobs: list[dict[str, Any]]) -> dict[str, Any]:
        evaluations = [job["evaluation"] for job in jobs]
        scores = medians(evaluations, ("mae", "mae_noise_free", "coverage_95"))
        return scores | medians(jobs, ("nll",)) | medians(evaluations, ("noise_std",))

    @override
    def rows(self, summary: Mapping[str, Any]) -> list[Row]:
        out: list[Row] = []
        for kind in ("schedules", "filters"):
            for model, variants in summary[kind].items():
                for variant, scores in variants.items():
                    row: Row = {"what": kind, "model": MODELS[model].label, "variant": variant}
                    out.append(row | in_columns({name: value for name, value in scores.items() if value}))
        return out

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        parts = (self._search_text, self._filter_text, self._overlap_text, self._floor_text)
        return "\n\n".join(part(summary) for part in parts)

    def _search_text(self, summary: Mapping[str, Any]) -> str:
        columns = {OURS: "ours", **SCHEDULES}
        rows = []
        for model, variants in summary["schedules"].items():
            paper = published.FIG2B_MAE[model].get(self.largest)
            rows.append(
                [MODELS[model].label, formatted(paper), *(formatted(variants[name]["mae"]) for name in columns)]
            )
        likelihoods = [
            [MODELS[model].label, *(formatted(variants[name]["nll"], 0) for name in SCHEDULES)]
            for model, variants in summary["schedules"].items()
        ]
        return (
            f"**Was the search converged?** The paper takes {PAPER_STEPS} steps of Adam (rate 0.2) from one start, and "
            "the starts of its models differ. The same models on the same data "
            f"(N = {self.largest}, seeds: {len(self.seeds)}), MAE against noisy accelerations; “ours” are the fits of "
            "figure 2b (hyperprior, several starts, one of them where the fit to fewer points ended); the others have "
            "one start and no hyperprior: L-BFGS from moments of the data, and Adam on the logarithms of all "
            "parameters, from ones:"
            "\n\n"
            + markdown_table(["model", "paper", *columns.values()], rows)
            + "\n\nNegative log likelihood that each plain search reached (lower is better):\n\n"
            + markdown_table(["model", *SCHEDULES.values()], likelihoods)
        )

    def _filter_text(self, summary: Mapping[str, Any]) -> str:
        names = {
            name: "no filter" if name == "none" else f"{name} Hz" for name in next(iter(summary["filters"].values()))
        }
        rows = [
            [MODELS[model].label, *(f"{formatted(variants[n]['mae_noise_free'])}" for n in names)]
            for model, variants in summary["filters"].items()
        ]
        noise = [
            [f"{MODELS[model].label}: learned noise std", *(formatted(variants[n]["noise_std"], 3) for n in names)]
            for model, variants in summary["filters"].items()
        ]
        return (
            "**Is the acceleration filtered?** The text mentions a low-pass filter, the reference implementation has "
            "none. A zero-phase Butterworth filter (order 4) on the noisy training accelerations before rows are "
            "chosen, noise level learned, one start; MAE against the noise-free accelerations [rad/s²]:\n\n"
            + markdown_table(["model", *names.values()], [*rows, *noise])
        )

    def _overlap_text(self, summary: Mapping[str, Any]) -> str:
        rows = [
            [
                MODELS[model].label,
                formatted(scores["shared"], 3),
                *(formatted(scores[name]) for name in ("mae", "mae_other", "mae_noise_free", "mae_noise_free_other")),
            ]
            for model, scores in summary["overlap"].items()
        ]
        header = ["model", "test rows trained on", "MAE same", "MAE other", "noise-free same", "noise-free other"]
        return (
            "**Are test rows training rows?** In the reference implementation the test window (1000 rows, every third "
            "step) lies inside the training trajectory. The same fits, tested on such a window (“same”, share of its "
            f"rows that are training rows first) and on another trajectory (“other”), N = {self.largest}:\n\n"
            + markdown_table(header, rows)
        )

    def _floor_text(self, summary: Mapping[str, Any]) -> str:
        return (
            f"**What can be reached?** With noise of {published.NOISE_STD} rad/s² a perfect model has an MAE of "
            "0.1 √(2/π) = 0.0798 against noisy accelerations. Close to it, the noise-free error, which is in the "
            "tables of figure 2b, too, shows more."
        )


def _schedule_name(model: str, schedule: str, seed: int) -> str:
    return f"ablation/search/{schedule}/{model}/seed{seed}"


def _overlap_name(model: str, seed: int) -> str:
    return f"ablation/overlap/{model}/seed{seed}"


def _filter_name(model: str, cutoff: float | None, seed: int) -> str:
    return f"ablation/filter/{'none' if cutoff is None else f'{cutoff:g}'}/{model}/seed{seed}"
