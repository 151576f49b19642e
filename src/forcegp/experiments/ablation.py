"""What the paper leaves unclear, and what each of it does to the numbers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from typing_extensions import override

from forcegp.evaluation.metrics import formatted, in_columns, medians
from forcegp.experiments import published
from forcegp.experiments.ablation_jobs import PAPER_STEPS, SCHEDULES
from forcegp.experiments.experiment import Experiment, Row, model_rows, model_table
from forcegp.experiments.fits import GAUSSIAN_PROCESSES, MODELS, FitSettings, fit_cost, fit_name, fit_series
from forcegp.jobs import Job, JobStore

TASKS = "forcegp.experiments.ablation_jobs"
OURS = "ours"
FILTERED_MODELS = ("s-gp-mean",)
OVERLAP_MODELS = ("gp", "s-gp-mean")
ERRORS = ("mae", "mae_noise_free")

# names of jobs, by variant, model and seed
_search_name = "ablation/search/{}/{}/seed{}".format
_filter_name = "ablation/filter/{}/{}/seed{}".format
_overlap_name = "ablation/overlap/{}/seed{}".format


@dataclass(frozen=True)
class Ablation(Experiment):
    """Schedules of the search at `points[-1]` points, a low-pass filter, and test rows among the training rows."""

    name, title = "ablation", "What the paper leaves unclear, measured"

    points: tuple[int, ...]
    seeds: tuple[int, ...]
    settings: FitSettings
    cutoffs: tuple[float, ...]
    steps: int = PAPER_STEPS

    @property
    def largest(self) -> int:
        """The number of points that everything here is measured at."""
        return max(self.points)

    @property
    def _filters(self) -> dict[str, float | None]:
        return {"none": None, **{f"{cutoff:g}": cutoff for cutoff in self.cutoffs}}

    @override
    def jobs(self) -> list[Job]:
        out: list[Job] = []
        search = {name: self.settings.of(self.largest)[name] for name in ("iterations", "tolerance")}
        for seed in self.seeds:
            data = self.data.job(seed)
            out.append(data)
            base = {"points": self.largest, **search, "data": data.name, "seed": seed}
            seconds = {"train_seconds": self.data.train_seconds}
            for model in GAUSSIAN_PROCESSES:
                out += fit_series(model, data.name, seed, self.points, self.settings)
                for schedule in SCHEDULES:
                    spec = {**base, "model": model, "schedule": schedule, "steps": self.steps}
                    cost = fit_cost(model, self.largest, {"restarts": 4, **search})
                    out.append(Job(_search_name(schedule, model, seed), f"{TASKS}:search", spec, (data.name,), cost))
            for model in FILTERED_MODELS:
                for variant, cutoff in self._filters.items():
                    spec = {**base, "model": model, "cutoff": cutoff, **seconds}
                    cost = 15.0 + fit_cost(model, self.largest, {"restarts": 1, **search})
                    out.append(Job(_filter_name(variant, model, seed), f"{TASKS}:filtered", spec, (data.name,), cost))
            for model in OVERLAP_MODELS:
                fit = fit_name(model, self.largest, seed)
                spec = {"fit": fit, "data": data.name, "seed": seed, **seconds}
                out.append(Job(_overlap_name(model, seed), f"{TASKS}:overlap", spec, (fit,), 20.0))
        return out

    @override
    def summary(self, results: JobStore) -> dict[str, Any]:
        def found(name: Callable[..., str], *which: str | int) -> list[dict[str, Any]]:
            return [results.result(name(*which, seed)) for seed in self.seeds]

        fits = {model: found(fit_name, model, self.largest) for model in GAUSSIAN_PROCESSES}
        schedules = {
            model: {OURS: _scores(ours)} | {each: _scores(found(_search_name, each, model)) for each in SCHEDULES}
            for model, ours in fits.items()
        }
        filters = {
            model: {variant: _scores(found(_filter_name, variant, model)) for variant in self._filters}
            for model in FILTERED_MODELS
        }
        overlap = {}
        for model in OVERLAP_MODELS:
            other = medians([job["evaluation"] for job in fits[model]], ERRORS)
            overlap[model] = medians(found(_overlap_name, model), (*ERRORS, "shared"))
            overlap[model] |= {f"{name}_other": each for name, each in other.items()}
        return {"points": self.largest, "schedules": schedules, "filters": filters, "overlap": overlap}

    @override
    def rows(self, summary: Mapping[str, Any]) -> list[Row]:
        return [
            {"what": kind, "model": MODELS[model].label, "variant": variant}
            | in_columns({name: value for name, value in scores.items() if value})
            for kind in ("schedules", "filters")
            for model, variants in summary[kind].items()
            for variant, scores in variants.items()
        ]

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        schedules, filters = summary["schedules"], summary["filters"]
        columns = {OURS: "ours", **SCHEDULES}
        searches = {
            model: [formatted(published.FIG2B_MAE[model].get(self.largest)), *_cells(variants, columns, "mae")]
            for model, variants in schedules.items()
        }
        likelihoods = {model: _cells(variants, SCHEDULES, "nll", 0) for model, variants in schedules.items()}
        names = {name: "no filter" if name == "none" else f"{name} Hz" for name in next(iter(filters.values()))}
        errors = {model: _cells(variants, names, "mae_noise_free") for model, variants in filters.items()}
        noise = {model: _cells(variants, names, "noise_std", 3) for model, variants in filters.items()}
        overlap = {
            model: [formatted(scores["shared"], 3)]
            + [formatted(scores[f"{name}{which}"]) for name in ERRORS for which in ("", "_other")]
            for model, scores in summary["overlap"].items()
        }
        header = ("test rows trained on", "MAE same", "MAE other", "noise-free same", "noise-free other")
        return "\n\n".join(
            [
                f"**Was the search converged?** The paper takes {PAPER_STEPS} steps of Adam (rate 0.2) from one start, "
                "and the starts of its models differ. The same models on the same data "
                f"(N = {self.largest}, seeds: {len(self.seeds)}), MAE against noisy accelerations; “ours” are the fits "
                "of figure 2b (hyperprior, several starts, one of them where the fit to fewer points ended); the "
                "others have one start and no hyperprior: L-BFGS from moments of the data, and Adam on the logarithms "
                "of all parameters, from ones:",
                model_table(["paper", *columns.values()], searches),
                "Negative log likelihood that each plain search reached (lower is better):",
                model_table(SCHEDULES.values(), likelihoods),
                "**Is the acceleration filtered?** The text mentions a low-pass filter, the reference implementation "
                "has none. A zero-phase Butterworth filter (order 4) on the noisy training accelerations before rows "
                "are chosen, noise level learned, one start; MAE against the noise-free accelerations [rad/s²]:",
                model_table(names.values(), errors, model_rows(noise, ": learned noise std")),
                "**Are test rows training rows?** In the reference implementation the test window (1000 rows, every "
                "third step) lies inside the training trajectory. The same fits, tested on such a window (“same”, "
                "share of its rows that are training rows first) and on another trajectory (“other”), "
                f"N = {self.largest}:",
                model_table(header, overlap),
                f"**What can be reached?** With noise of {published.NOISE_STD} rad/s² a perfect model has an MAE of "
                "0.1 √(2/π) = 0.0798 against noisy accelerations. Close to it, the noise-free error, which is in the "
                "tables of figure 2b, too, shows more.",
            ]
        )


def _scores(jobs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    evaluations = [job["evaluation"] for job in jobs]
    scores = medians(evaluations, (*ERRORS, "coverage_95"))
    return scores | medians(jobs, ("nll",)) | medians(evaluations, ("noise_std",))


def _cells(variants: Mapping[str, Any], names: Mapping[str, str], score: str, digits: int = 4) -> list[str]:
    return [formatted(variants[name][score], digits) for name in names]
