"""Friction as it is: Coulomb, Stribeck, proportional to the load, in the joints, and what each prior makes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from matplotlib.figure import Figure
from typing_extensions import override

from forcegp.evaluation import friction_curves_figure, normal_force_figure
from forcegp.evaluation.summary_statistics import formatted
from forcegp.experiments.force_experiment import (
    LABELS,
    ForceExperiment,
    Trial,
    dots_figure,
    only_test,
    score_table,
    trial_name,
)
from forcegp.experiments.force_jobs import MODEL, load
from forcegp.jobs import JobStore
from forcegp.models import load_posterior

TOOL = {
    "joint forces (the paper's)": "joint",
    "tool friction": "tool-friction",
    "tool forces on velocity and place": "tool-forces",
    "contact friction": "contact-friction",
    "load friction": "load-friction",
}
WITH_JOINTS = {
    "joint forces (the paper's)": "joint",
    "joint + tool friction": "joint-friction+tool-friction",
    "joint + contact friction": "joint-friction+contact-friction",
    "joint + load friction": "joint-friction+load-friction",
}
PRIORS = {
    "viscous": TOOL,
    "coulomb": TOOL,
    "stribeck": TOOL,
    "viscous-joints": WITH_JOINTS,
    "stribeck-joints": WITH_JOINTS,
}
PICTURED = ("stribeck-joints", "joint + load friction")


@dataclass(frozen=True)
class Friction(ForceExperiment):
    """Every prior that means something in a scenario, at one number of points."""

    name: ClassVar[str] = "friction"
    title: ClassVar[str] = "Friction as it is"

    @override
    def trials(self) -> list[Trial]:
        return [
            Trial(label, scenario, prior, points)
            for scenario, priors in PRIORS.items()
            for label, prior in priors.items()
            for points in self.points
        ]

    @override
    def figures(self, summary: Mapping[str, Any], results: JobStore) -> dict[str, Figure]:
        groups = {
            LABELS[scenario]: {
                trial["label"]: only_test(trial) for trial in summary["trials"] if trial["scenario"] == scenario
            }
            for scenario in ("stribeck", "stribeck-joints")
        }
        (pictured,) = [t for t in self.trials()[:: len(self.points)] if (t.scenario, t.label) == PICTURED]
        seed = self.seeds[0]
        posterior = load_posterior(results.place(trial_name(pictured, seed)) / MODEL)
        test = load(results, self.data_job(pictured.scenario, seed, training=False).name)
        return {
            "friction-errors": dots_figure(groups, "mae_noise_free", "mean absolute error, noise-free [rad/s²]"),
            "friction-curves": friction_curves_figure(posterior, test),
            "friction-normal-force": normal_force_figure(posterior, test),
        }

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        columns = ("mae", "mae_noise_free", "normal_force_error", "normal_force_coverage", "component_sum_error")
        parts = [
            f"{', '.join(map(str, self.points))} points, analytical mean, {len(self.seeds)} seeds. The normal force is "
            "that of the simulation; its error is relative to its own root mean square. “Sum of components” is the "
            "largest difference between the sum of all component forces and the total. “Curve in its band” is "
            "the share of the visited velocities at which the 95 % band of a friction curve holds the law that was "
            "simulated, mean over the model's curves, where its prior has such a law. The pictures show the last model "
            "of the last table."
        ]
        for scenario in PRIORS:
            trials = [trial for trial in summary["trials"] if trial["scenario"] == scenario]
            parts += [f"**{LABELS[scenario][0].upper()}{LABELS[scenario][1:]}**", score_table(trials, columns)]
            curves = [
                f"{trial['label']} {formatted(trial['curve_coverage_of_seeds'], 3)}"
                for trial in trials
                if trial["curve_coverage_of_seeds"] is not None
            ]
            if curves:
                parts.append(f"Curve in its band: {'; '.join(curves)}.")
        return "\n\n".join(parts)
