"""Friction as it is, in every contact: Coulomb, Stribeck, under load, on other surfaces, and with one that opens."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from matplotlib.figure import Figure
from typing_extensions import override

from forcegp.evaluation import friction_curves_figure, normal_force_figure
from forcegp.evaluation.metrics import formatted, markdown_table, medians
from forcegp.experiments.experiment import heading
from forcegp.experiments.force_experiment import (
    LABELS,
    ForceExperiment,
    Trial,
    dots_figure,
    only_test,
    score_table,
    trial_name,
    trials_on,
)
from forcegp.experiments.force_jobs import BLACK_BOX, KNOWN_PHYSICS, MODEL, load
from forcegp.jobs import JobStore
from forcegp.models import load_posterior

JOINT_FORCES = "joint forces (the paper's)"
TOOL = {
    JOINT_FORCES: "joint",
    "tool friction": "tool-friction",
    "tool forces on velocity and place": "tool-forces",
    "contact friction": "contact-friction",
    "load friction": "load-friction",
}
WITH_JOINTS = {
    JOINT_FORCES: "joint",
    "joint + tool friction": "joint-friction+tool-friction",
    "joint + contact friction": "joint-friction+contact-friction",
    "joint + load friction": "joint-friction+load-friction",
}
PRIORS = dict.fromkeys(("viscous", "coulomb", "stribeck"), TOOL)
PRIORS |= dict.fromkeys(("viscous-joints", "stribeck-joints"), WITH_JOINTS)
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
            LABELS[scenario]: {trial["label"]: only_test(trial) for trial in trials_on(scenario, summary)}
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
            trials = trials_on(scenario, summary)
            parts += [heading(LABELS[scenario]), score_table(trials, columns)]
            curves = [
                f"{trial['label']} {formatted(trial['curve_coverage_of_seeds'], 3)}"
                for trial in trials
                if trial["curve_coverage_of_seeds"] is not None
            ]
            if curves:
                parts.append(f"Curve in its band: {'; '.join(curves)}.")
        return "\n\n".join(parts)


SURFACES = {"plane": "viscous", "tilted plane": "tilted", "sphere": "sphere"}
SURFACES_AND_JOINTS = {
    "plane": "viscous-joints",
    "tilted plane": "tilted-joints",
    "sphere": "sphere-joints",
    "free motion": "free-joints",
}


@dataclass(frozen=True)
class Transfer(ForceExperiment):
    """Trained on the plane, tested on every other surface."""

    name: ClassVar[str] = "transfer"
    title: ClassVar[str] = "Transfer to other contacts"

    @override
    def trials(self) -> list[Trial]:
        return [
            Trial(label, scenario, priors[label], points, tests)
            for points in self.points
            for scenario, priors, tests, labels in (
                ("viscous", TOOL, SURFACES, ("tool friction", "contact friction", JOINT_FORCES)),
                ("viscous-joints", WITH_JOINTS, SURFACES_AND_JOINTS, ("joint + tool friction", JOINT_FORCES)),
            )
            for label in labels
        ]

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        parts = [
            f"`posterior.with_contacts(...)`: trained on the plane, analytical mean, {len(self.seeds)} seeds; MAE "
            "against noise-free accelerations [rad/s²], and in brackets how many times as large as on the plane "
            "(ratio of medians)."
        ]
        for scenario, tests, title in (
            ("viscous", SURFACES, "Viscous friction at the tool"),
            ("viscous-joints", SURFACES_AND_JOINTS, "Viscous friction at the tool, Stribeck friction in the joints"),
        ):
            rows = []
            for trial in trials_on(scenario, summary):
                home = trial["tests"]["plane"]["mae_noise_free"]
                errors = [trial["tests"][label]["mae_noise_free"] for label in tests]
                cells = [f"{formatted(error)} [{error['median'] / home['median']:.2f}]" for error in errors]
                rows.append([trial["label"], str(trial["points"]), *cells])
            parts += [f"**{title}**", markdown_table(["model", "points", *tests], rows)]
        return "\n\n".join(parts)


MODELS = {
    "known physics alone": KNOWN_PHYSICS,
    "independent GP": BLACK_BOX,
    **{label: TOOL[label] for label in (JOINT_FORCES, "tool friction", "contact friction", "load friction")},
}


@dataclass(frozen=True)
class UnilateralContact(ForceExperiment):
    """Trained on rows that the data show to be in contact."""

    name: ClassVar[str] = "unilateral-contact"
    title: ClassVar[str] = "A contact that opens and closes"

    @override
    def trials(self) -> list[Trial]:
        return [Trial(label, "bullet", prior, points) for label, prior in MODELS.items() for points in self.points]

    @override
    def summary(self, results: JobStore) -> dict[str, Any]:
        found = [results.result(self.data_job("bullet", seed, training=True).name) for seed in self.seeds]
        return super().summary(results) | medians(found, ("in_contact_truth", "in_contact_detected"))

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        columns = ("mae", "mae_noise_free", "mae_touching", "mae_in_the_air", "coverage_95", "normal_force_error")
        return (
            "PyBullet's unilateral contact with Coulomb friction, from which the tool lifts now and then: "
            f"{formatted(summary['in_contact_truth'], 3)} of the rows are in contact, "
            f"{formatted(summary['in_contact_detected'], 3)} are found to be so from positions, velocities and "
            f"accelerations alone (`forcegp.data.rows_in_contact`); models are trained on these. "
            f"{len(self.seeds)} seeds. All models but the independent GP hold the contact for an ideal one, so in "
            "the air they are wrong, and where the tool lands or takes off nothing predicts the blow.\n\n"
        ) + score_table(summary["trials"], columns)
