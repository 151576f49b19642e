"""Extrapolation: trained in one half of the workspace (and slowly), tested in the other (and faster)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure
from typing_extensions import override

from forcegp.evaluation.metrics import formatted, in_columns, markdown_table, medians
from forcegp.experiments.experiment import Experiment, Row, heading, model_table
from forcegp.experiments.extrapolation_jobs import REGIONS, SIDES, TEST_X, TRAIN_X
from forcegp.experiments.figures import extrapolation_figure
from forcegp.experiments.fits import ANALYTICAL, GAUSSIAN_PROCESSES, MODELS, NETWORKS, FitSettings, fit_cost
from forcegp.jobs import Job, JobStore

TASKS = "forcegp.experiments.extrapolation_jobs"
_fit_name = "extrapolation/{}/{}/seed{}".format  # region, model, seed
_scale_name = "extrapolation/scale/seed{}".format
SCORES = ("mae_noise_free", "mae", "nlpd", "coverage_95", "constraint_error")
OUTSIDE = {"nlpd": 1, "coverage_95": 3, "constraint_error": 4}  # further scores of the page, and their decimals

TARGETS = {
    "acceleration": "the acceleration a, which the GP learns [rad/s²]",
    "unconstrained_acceleration": "the acceleration without constraint, which S-GP [38] learns [rad/s²]",
    "all_forces": "all joint forces Q_K + Q_U, which S-GP without mean learns [Nm]",
    "unknown_force": "the unknown joint force Q_U, which is left with the analytical mean [Nm]",
}


@dataclass(frozen=True)
class Extrapolation(Experiment):
    """Gaussian processes and analytical models on `points` rows, networks on all training rows of the region."""

    name, title = "extrapolation", "Extrapolation: the other half of the table, and faster"

    points: int
    seeds: tuple[int, ...]
    settings: FitSettings
    models: tuple[str, ...] = (*NETWORKS, *GAUSSIAN_PROCESSES, *ANALYTICAL)

    @override
    def jobs(self) -> list[Job]:
        out: list[Job] = []
        for seed in self.seeds:
            data = self.data.job(seed)
            out += [data, Job(_scale_name(seed), f"{TASKS}:scale", {"data": data.name}, (data.name,), 3.0)]
            for region in REGIONS:
                for model in self.models:
                    points = None if model in NETWORKS else self.points
                    settings = self.settings.of_network() if model in NETWORKS else self.settings.of(self.points)
                    spec = {"model": model, "data": data.name, "region": region, "points": points, "seed": seed}
                    cost = 30.0 if model in NETWORKS else fit_cost(model, self.points, settings)
                    out.append(Job(_fit_name(region, model, seed), f"{TASKS}:fit", spec | settings, (data.name,), cost))
        return out

    @override
    def summary(self, results: JobStore) -> dict[str, Any]:
        regions: dict[str, Any] = {region: {} for region in REGIONS}
        for region, of_models in regions.items():
            for model in self.models:
                found = [results.result(_fit_name(region, model, seed)) for seed in self.seeds]
                scores = {side: medians([job[side] for job in found], SCORES) for side in SIDES}
                of_models[model] = scores | medians(found, ("points",))
        scales = [results.result(_scale_name(seed)) for seed in self.seeds]
        return {"points": self.points, "regions": regions, "scale": medians(scales, (*TARGETS, "largest_H"))}

    @override
    def rows(self, summary: Mapping[str, Any]) -> list[Row]:
        return [
            {"region": region, "model": MODELS[model].label, "points": scores["points"]["median"], "tested": side}
            | in_columns(scores[side])
            for region, models in summary["regions"].items()
            for model, scores in models.items()
            for side in SIDES
        ]

    @override
    def figures(self, summary: Mapping[str, Any], results: JobStore) -> dict[str, Figure]:
        return {"extrapolation": extrapolation_figure(summary)}

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        parts = [
            f"Trained on {self.points} farthest points with the tool at x < {TRAIN_X} m (networks on all such rows of "
            f"the training set), tested on other trajectories: inside (x < {TRAIN_X} m) and outside (x > {TEST_X} m). "
            "For “faster”, training and inside rows have a tool speed below the median of the training set (which "
            "farthest-point sampling makes fast), outside rows one above it. "
            f"{len(self.seeds)} seeds; errors against the noise-free acceleration."
        ]
        header = ("points", "MAE inside", "MAE outside", "NLPD outside", "coverage outside", "\\|A a − b\\|")
        for region, label in REGIONS.items():
            cells = {
                model: [
                    f"{scores['points']['median']:.0f}",
                    *(formatted(scores[side]["mae_noise_free"]) for side in SIDES),
                    *(formatted(scores["outside"][name], digits) for name, digits in OUTSIDE.items()),
                ]
                for model, scores in summary["regions"][region].items()
            }
            parts += [heading(label), model_table(header, cells)]
        scale = summary["scale"]
        parts += [
            "What each model was left to learn, root mean square over training rows. A Gaussian process falls back to "
            "zero away from its data, so this is the size that its errors can reach there; a force error reaches the "
            "acceleration through H, whose largest entry on these data is "
            f"{formatted(scale['largest_H'], 0)} /(kg m²).",
            markdown_table(["what", "size"], [[text, formatted(scale[key], 2)] for key, text in TARGETS.items()]),
        ]
        return "\n\n".join(parts)
