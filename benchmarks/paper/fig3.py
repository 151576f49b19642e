"""Figure 3: what four models predict for the same three seconds, with their 95 % intervals."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from benchmarks.paper.data import test_trajectory
from benchmarks.paper.experiment import Experiment, Row, stored_arrays
from benchmarks.paper.figures import prediction_window_figure
from benchmarks.paper.fits import GAUSSIAN_PROCESSES, MODEL, MODELS, FitSettings, fit_name, fit_series
from forcegp.errors import InvalidInput
from forcegp.jobs import Job, JobStore
from forcegp.posterior import load_posterior
from forcegp.scores.accuracy import metrics
from forcegp.scores.page import markdown_table, number

ARRAYS = "prediction.npz"


@dataclass(frozen=True)
class Fig3(Experiment):
    """The first `points` rows of one seed, and `seconds` of its test trajectory from `start` on."""

    name, title = "fig3", "Figure 3: four models on the same three seconds"

    points: tuple[int, ...]
    seed: int
    start: float
    seconds: float
    settings: FitSettings
    models: tuple[str, ...] = GAUSSIAN_PROCESSES

    @override
    def jobs(self) -> list[Job]:
        data = self.data.job(self.seed)
        out = [data]
        for model in self.models:
            series = fit_series(model, data.name, self.seed, self.points, self.settings)
            spec = {"fit": series[-1].name, "data": data.name, "start": self.start, "seconds": self.seconds}
            out += [*series, Job(self._name(model), "benchmarks.paper.fig3:predict", spec, (series[-1].name,), 3.0)]
        return out

    def _name(self, model: str) -> str:
        return f"fig3/{fit_name(model, max(self.points), self.seed).removeprefix('fits/')}"

    @override
    def summary(self, results: JobStore) -> dict[str, Any]:
        models = {model: results.result(self._name(model)) for model in self.models}
        return {"points": max(self.points), "seed": self.seed, "models": models}

    @override
    def rows(self, summary: Mapping[str, Any]) -> list[Row]:
        return [
            {"model": MODELS[model].label, "points": summary["points"], **scores}
            for model, scores in summary["models"].items()
        ]

    @override
    def figures(self, summary: Mapping[str, Any], results: JobStore) -> dict[str, Figure]:
        arrays = {model: stored_arrays(results, self._name(model), ARRAYS) for model in self.models}
        return {"fig3": prediction_window_figure(arrays)}

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        digits = {"mae_noise_free": 4, "mean_std": 4, "coverage_95_noise_free": 3, "coverage_95": 3}
        header = ("model", "MAE, noise-free", "mean std of the prediction", "truth inside 95 %", "measured inside 95 %")
        rows = [
            [MODELS[model].label, *(number(scores[name], each) for name, each in digits.items())]
            for model, scores in summary["models"].items()
        ]
        return (
            f"{summary['points']} training points, seed {summary['seed']}, {self.seconds:g} s of its test trajectory "
            f"(all joints in the table, three in the figure); rad/s².\n\n{markdown_table(header, rows)}"
        )


def predict(results: JobStore, spec: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Predict every row of the window and keep mean, deviations, truth and measurement."""
    posterior = load_posterior(results.place(spec["fit"]) / MODEL)
    trajectory = test_trajectory(results, spec["data"])
    elapsed = trajectory.time - trajectory.time[0]
    chosen = (elapsed >= spec["start"]) & (elapsed <= spec["start"] + spec["seconds"])
    if not chosen.any():
        raise InvalidInput(f"the test trajectory lasts {elapsed[-1]:.3g} s; the window begins at {spec['start']} s.")
    rows = trajectory.rows(chosen)
    prediction = posterior.predict(rows.q, rows.v, rows.u)
    mean, std, noisy = (x.numpy() for x in (prediction.mean, prediction.std, prediction.measurement.std))
    truth = np.asarray(rows.truth["a"])
    np.savez_compressed(
        folder / ARRAYS, time=elapsed[chosen], mean=mean, std=std, measurement_std=noisy, truth=truth, measured=rows.a
    )
    return {
        "rows": len(rows),
        "mae_noise_free": float(np.abs(mean - truth).mean()),
        "mean_std": float(std.mean()),
        "coverage_95_noise_free": mean_coverage(mean, std, truth),
        "coverage_95": mean_coverage(mean, noisy, rows.a),
    }


def mean_coverage(mean: np.ndarray, std: np.ndarray, target: np.ndarray) -> float:
    """Of 95 % intervals, over all joints."""
    return float(np.mean(np.array(metrics(mean, std**2, target)["coverage_95"], dtype=float)))
