"""Figure 2c: the tool's mass and centre of mass, learned along with everything else."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typing_extensions import override

from benchmarks.paper.experiment import Experiment, Row
from benchmarks.paper.fig2c_jobs import CENTER_BOUND, CENTER_OFFSET, MASS_BOUND, MASS_OFFSET, MODELS, NAMES
from benchmarks.paper.fits import fit_cost
from forcegp.jobs import Job, JobStore
from forcegp.scores.accuracy import median_and_range
from forcegp.scores.page import formatted, rendered

_estimate_name = "fig2c/{}/seed{}".format  # model, seed


@dataclass(frozen=True)
class Fig2c(Experiment):
    """Estimates at `points` points, with intervals, of several seeds."""

    name, title = "fig2c", "Figure 2c: the tool's mass and centre of mass"

    points: int
    seeds: tuple[int, ...]
    iterations: int
    tolerance: float

    @override
    def jobs(self) -> list[Job]:
        out = []
        search = {"iterations": self.iterations, "tolerance": self.tolerance}
        for seed in self.seeds:
            data = self.data.job(seed)
            out.append(data)
            for model in MODELS:
                spec = {"model": model, "data": data.name, "points": self.points, **search}
                cost = 10.0 + 3.0 * fit_cost("s-gp", self.points, {"restarts": 1, **search})
                task = "benchmarks.paper.fig2c_jobs:estimate"
                out.append(Job(_estimate_name(model, seed), task, spec, (data.name,), cost))
        return out

    @override
    def summary(self, results: JobStore) -> dict[str, Any]:
        found = {model: [results.result(_estimate_name(model, seed)) for seed in self.seeds] for model in MODELS}
        return {"points": self.points, "seeds": len(self.seeds), "models": {m: _of(x) for m, x in found.items()}}

    @override
    def rows(self, summary: Mapping[str, Any]) -> list[Row]:
        return [
            {"model": MODELS[model], "parameter": name, "inside": entry["inside"]}
            | {f"{what}_median": entry[what]["median"] for what in ("error", "std")}
            for model, each in summary["models"].items()
            for name, entry in each["parameters"].items()
        ]

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        rows = [
            [
                MODELS[model],
                name,
                formatted(entry["error"]),
                formatted(entry["std"]),
                f"{entry['inside']} of {summary['seeds']}",
            ]
            for model, each in summary["models"].items()
            for name, entry in each["parameters"].items()
        ]
        found = [
            [MODELS[model], f"{each['found']} of {summary['seeds']}", formatted(each["mae"])]
            for model, each in summary["models"].items()
        ]
        return rendered(
            Path(__file__).with_name("fig2c.md.jinja"),
            points=summary["points"],
            start_mass=MASS_OFFSET,
            start_center=CENTER_OFFSET,
            bounds=f"within {MASS_BOUND} kg and {1000 * CENTER_BOUND:g} mm",
            rows=rows,
            found=found,
        )


def _of(estimates: list[dict[str, Any]]) -> dict[str, Any]:
    """What the estimates of several seeds have in common."""
    good = (abs(x["error"]["mass"]) <= MASS_BOUND and x["center_error"] <= CENTER_BOUND for x in estimates)
    parameters = {
        name: {
            "inside": sum(each["inside"][name] for each in estimates),
            "error": median_and_range(abs(each["error"][name]) for each in estimates),
            "std": median_and_range(each["std"][name] for each in estimates),
        }
        for name in NAMES
    }
    return {"found": sum(good), "mae": median_and_range(x["mae"] for x in estimates), "parameters": parameters}
