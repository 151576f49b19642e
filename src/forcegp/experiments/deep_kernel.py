"""Where a deep kernel helps and where it does not, and whether leaving rows out predicts it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import override

from forcegp.evaluation.summary_statistics import formatted
from forcegp.experiments.force_experiment import ForceExperiment, Trial
from forcegp.experiments.force_scenarios import LABELS
from forcegp.experiments.force_tables import score_table

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
            trials = [trial for trial in summary["trials"] if trial["scenario"] == scenario]
            densities = [f"{t['label']}, N={t['points']}: {formatted(t['leave_one_out'], 3)}" for t in trials]
            heading = LABELS[scenario][0].upper() + LABELS[scenario][1:]
            parts += [f"**{heading}**", score_table(trials, columns), f"Leave-one-out: {'; '.join(densities)}."]
        return "\n\n".join(parts)
