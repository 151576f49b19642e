"""Other contacts than that of the training: other surfaces, none, and one that opens and closes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import override

from forcegp.evaluation.summary_statistics import formatted, markdown_table, medians
from forcegp.experiments.force_experiment import ForceExperiment, Trial, score_table
from forcegp.experiments.force_jobs import BLACK_BOX, KNOWN_PHYSICS
from forcegp.jobs import JobStore

TOOL = {"plane": "viscous", "tilted plane": "tilted", "sphere": "sphere"}
JOINTS = {
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
            trial
            for points in self.points
            for trial in (
                Trial("tool friction", "viscous", "tool-friction", points, TOOL),
                Trial("contact friction", "viscous", "contact-friction", points, TOOL),
                Trial("joint forces (the paper's)", "viscous", "joint", points, TOOL),
                Trial("joint + tool friction", "viscous-joints", "joint-friction+tool-friction", points, JOINTS),
                Trial("joint forces (the paper's)", "viscous-joints", "joint", points, JOINTS),
            )
        ]

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        parts = [
            f"`posterior.with_contacts(...)`: trained on the plane, analytical mean, {len(self.seeds)} seeds; MAE "
            "against noise-free accelerations [rad/s²], and in brackets how many times as large as on the plane "
            "(ratio of medians)."
        ]
        for scenario, tests, heading in (
            ("viscous", TOOL, "Viscous friction at the tool"),
            ("viscous-joints", JOINTS, "Viscous friction at the tool, Stribeck friction in the joints"),
        ):
            rows = []
            for trial in summary["trials"]:
                if trial["scenario"] == scenario:
                    home = trial["tests"]["plane"]["mae_noise_free"]
                    errors = [trial["tests"][label]["mae_noise_free"] for label in tests]
                    cells = [f"{formatted(error)} [{error['median'] / home['median']:.2f}]" for error in errors]
                    rows.append([trial["label"], str(trial["points"]), *cells])
            parts += [f"**{heading}**", markdown_table(["model", "points", *tests], rows)]
        return "\n\n".join(parts)


MODELS = {
    "known physics alone": KNOWN_PHYSICS,
    "independent GP": BLACK_BOX,
    "joint forces (the paper's)": "joint",
    "tool friction": "tool-friction",
    "contact friction": "contact-friction",
    "load friction": "load-friction",
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
        return "\n\n".join(
            [
                "PyBullet's unilateral contact with Coulomb friction, from which the tool lifts now and then: "
                f"{formatted(summary['in_contact_truth'], 3)} of the rows are in contact, "
                f"{formatted(summary['in_contact_detected'], 3)} are found to be so from positions, velocities and "
                f"accelerations alone (`forcegp.data.rows_in_contact`); models are trained on these. "
                f"{len(self.seeds)} seeds. All models but the independent GP hold the contact for an ideal one, so in "
                "the air they are wrong, and where the tool lands or takes off nothing predicts the blow.",
                score_table(summary["trials"], columns),
            ]
        )
