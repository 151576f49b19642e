"""Errors against few training points, outside of where models were trained too, and a deep kernel."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi
from typing import Any, ClassVar

from matplotlib.figure import Figure
from typing_extensions import override

from forcegp.evaluation.metrics import formatted
from forcegp.evaluation.plots.style import QUIET, SERIES, legend_below, new_figure, quiet
from forcegp.experiments import published
from forcegp.experiments.experiment import heading
from forcegp.experiments.figures import draw_range
from forcegp.experiments.force_experiment import (
    LABELS,
    ForceExperiment,
    Trial,
    only_test,
    plain_ticks,
    score_table,
    trials_on,
)
from forcegp.jobs import JobStore

PRIORS = {
    "joint forces on (q, v, u), the paper's": "joint",
    "tool friction": "tool-friction",
    "contact friction, isotropic": "contact-friction",
}


@dataclass(frozen=True)
class DataEfficiency(ForceExperiment):
    """Every prior with the analytical mean at growing N; `region_points` of them for the extrapolation."""

    name: ClassVar[str] = "data-efficiency"
    title: ClassVar[str] = "Data efficiency"

    region_points: int = 50

    @override
    def trials(self) -> list[Trial]:
        curves = [Trial(label, "viscous", prior, n) for label, prior in PRIORS.items() for n in self.points]
        region = [Trial(label, "viscous", prior, self.region_points, region=True) for label, prior in PRIORS.items()]
        return [*curves, *region]

    @override
    def figures(self, summary: Mapping[str, Any], results: JobStore) -> dict[str, Figure]:
        figure = new_figure(8.6, 3.8)
        panels = figure.subplots(1, 2)
        scores = {"mae": "against noisy accelerations", "mae_noise_free": "against noise-free ones"}
        for axes, (score, title) in zip(panels, scores.items(), strict=True):
            for color, label in zip((SERIES[1], SERIES[0], SERIES[2]), PRIORS, strict=True):
                trials = [trial for trial in summary["trials"] if trial["label"] == label and not trial["region"]]
                draw_range(axes, {trial["points"]: only_test(trial)[score] for trial in trials}, color, label)
            axes.set(xscale="log", yscale="log")
            quiet(axes, title=f"MAE {title} [rad/s²]", x="training points N", y="")
        paper = published.FIG2B_MAE["s-gp-mean"]
        label = "S-GP + mean, published (2021)"
        panels[0].plot(list(paper), list(paper.values()), color=QUIET, linestyle="--", linewidth=1.0, label=label)
        perfect = published.NOISE_STD * (2.0 / pi) ** 0.5
        panels[0].axhline(perfect, color=QUIET, linewidth=0.8, label="a perfect prediction")
        for axes in panels:
            plain_ticks(axes.xaxis)
            plain_ticks(axes.yaxis)
        legend_below(figure, panels[0], columns=2)
        return {"data-efficiency": figure}

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        columns = ("mae", "mae_noise_free", "nlpd", "coverage_95", "normal_force_error", "normal_force_coverage")
        outside, inside = ([t for t in summary["trials"] if t["region"] == region] for region in (True, False))
        best = published.FIG2B_MAE["s-gp-mean"][1000]
        return "\n\n".join(
            [
                f"The paper's scenario, analytical mean, {len(self.seeds)} seeds. The paper's best model has an MAE of "
                f"{best} with 1000 points. A perfect one has the mean of the noise: 0.0798 in the long run, on these "
                f"test rows {formatted(only_test(inside[0]).get('mae_of_truth'))}.",
                score_table(inside, columns),
                "**Extrapolation**: trained on rows with the tool at x < 0, tested at x > 0.1 m.",
                score_table(outside, columns[:4]),
            ]
        )


KERNELS = {
    "squared exponential": "friction-map",
    "Matérn 3/2": "friction-map:kernel=matern-3/2",
    "deep": "friction-map:kernel=deep",
}
SCENARIOS = ("patch", "viscous")


@dataclass(frozen=True)
class DeepKernel(ForceExperiment):
    """A map of friction over the table, on a strip of other friction and without one."""

    name: ClassVar[str] = "deep-kernel"
    title: ClassVar[str] = "Deep kernels"

    @override
    def trials(self) -> list[Trial]:
        return [
            Trial(f"{label} kernel", scenario, prior, points)
            for scenario in SCENARIOS
            for points in self.points
            for label, prior in KERNELS.items()
        ]

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        parts = [
            "`friction-map`: viscous friction whose coefficient depends on the place, analytical mean, "
            f"{len(self.seeds)} seeds. Leave-one-out: log density of a training row given all others, in nats per row, "
            "from the same fit; the higher, the better. `forcegp compare` chooses by that of stretches of time."
        ]
        columns = ("mae_noise_free", "nlpd", "coverage_95")
        for scenario in SCENARIOS:
            trials = trials_on(scenario, summary)
            densities = [f"{t['label']}, N={t['points']}: {formatted(t['leave_one_out'], 3)}" for t in trials]
            texts = (heading(LABELS[scenario]), score_table(trials, columns))
            parts += [*texts, f"Leave-one-out: {'; '.join(densities)}."]
        return "\n\n".join(parts)
