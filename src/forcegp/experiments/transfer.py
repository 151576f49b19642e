"""Transfer: forces learned under one contact, used under another or none, without another fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from typing_extensions import override

from forcegp.evaluation.summary_statistics import formatted, markdown_table
from forcegp.experiments.force_experiment import ForceExperiment, Trial

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
