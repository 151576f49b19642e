"""PyBullet's own contact: what an ideal constraint makes of a contact that opens and closes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import override

from forcegp.evaluation.summary_statistics import formatted, medians
from forcegp.experiments.force_experiment import ForceExperiment, Trial
from forcegp.experiments.force_jobs import BLACK_BOX, KNOWN_PHYSICS
from forcegp.experiments.force_tables import score_table
from forcegp.jobs import JobStore

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
