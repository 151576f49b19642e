"""Figure 2c: the tool's mass and centre of mass, learned along with everything else."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from typing_extensions import override

from benchmarks.paper.experiment import Experiment, Row
from benchmarks.paper.fig2c_jobs import CENTER_BOUND, MASS_BOUND, MEANS, MODELS
from benchmarks.paper.figures import estimation_figure
from benchmarks.paper.fits import fit_cost
from forcegp.evaluation.metrics import formatted, median_and_range, number
from forcegp.evaluation.pages import rendered
from forcegp.jobs import Job, JobStore

TASKS = "benchmarks.paper.fig2c_jobs"
AXES = ("com.x", "com.y", "com.z")
ERRORS = ("mass_error", "center_error", "mae")
_trace_name = "fig2c/trace/{}/{}".format  # model, mean
_estimate_name = "fig2c/estimate/seed{}".format


@dataclass(frozen=True)
class Fig2c(Experiment):
    """Traces at `points` points from one seed; estimates with standard errors at `points_interval` points."""

    name, title = "fig2c", "Figure 2c: the tool's mass and centre of mass"

    points: int
    seed: int
    points_interval: int
    seeds: tuple[int, ...]
    iterations: int
    tolerance: float

    @override
    def jobs(self) -> list[Job]:
        data = {seed: self.data.job(seed) for seed in sorted({self.seed, *self.seeds})}
        out = list(data.values())
        search = {"iterations": self.iterations, "tolerance": self.tolerance}
        for model in MODELS:
            for mean in MEANS:
                where = data[self.seed].name
                spec = {"model": model, "mean": mean, "data": where, "points": self.points, **search}
                cost = 10.0 + fit_cost("s-gp", self.points, {"restarts": 1, **search}) * (model == "s-gp")
                out.append(Job(_trace_name(model, mean), f"{TASKS}:trace", spec, (where,), cost))
        for seed in self.seeds:
            spec = {"data": data[seed].name, "points": self.points_interval, **search}
            cost = 3.0 * fit_cost("s-gp", self.points_interval, {"restarts": 1, **search})
            out.append(Job(_estimate_name(seed), f"{TASKS}:estimate", spec, (data[seed].name,), cost))
        return out

    @override
    def summary(self, results: JobStore) -> dict[str, Any]:
        traces = {model: {mean: results.result(_trace_name(model, mean)) for mean in MEANS} for model in MODELS}
        for model in traces.values():
            for trace in model.values():
                trace["found_at"] = _found_at(trace)
        estimates = [results.result(_estimate_name(seed)) for seed in self.seeds]
        intervals = {
            name: {
                # of the 95 % intervals; one of infinite width holds everything
                "inside": sum(
                    x["std"][name] is None or abs(x["error"][name]) <= 1.96 * x["std"][name] for x in estimates
                ),
                "error": median_and_range(abs(each["error"][name]) for each in estimates),
                "std": median_and_range(each["std"][name] for each in estimates),
            }
            for name in estimates[0]["error"]
        }
        out = {"points": self.points, "traces": traces, "intervals": intervals, "seeds": len(estimates)}
        return out | {"converged": sum(each["converged"] for each in estimates)}

    @override
    def rows(self, summary: Mapping[str, Any]) -> list[Row]:
        return [
            {"model": MODELS[model], "mean": mean, "iteration": iteration}
            | {name: trace[name][iteration] for name in ERRORS}
            for model, means in summary["traces"].items()
            for mean, trace in means.items()
            for iteration in range(len(trace["mass_error"]))
        ]

    @override
    def figures(self, summary: Mapping[str, Any], results: JobStore) -> dict[str, Figure]:
        return {"fig2c": estimation_figure(summary)}

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        rows, verdicts = [], []
        for model, means in summary["traces"].items():
            for mean, trace in means.items():
                last = [number(trace[name][-1]) for name in ERRORS]
                found = "never" if trace["found_at"] is None else str(trace["found_at"])
                std = [formatted(trace["std"]["mass"]), " ".join(formatted(trace["std"][axis]) for axis in AXES)]
                iterations = f"{len(trace['mass_error']) - 1}{'' if trace['converged'] else ' (limit)'}"
                label = f"{MODELS[model]}, {MEANS[mean]}"
                rows.append([label, iterations, found, *last[:2], *std, last[2]])
                verdicts.append((label, trace["verdict"]))
        intervals = [
            [name, formatted(entry["error"]), formatted(entry["std"]), f"{entry['inside']} of {summary['seeds']}"]
            for name, entry in summary["intervals"].items()
        ]
        return rendered(
            Path(__file__).with_name("fig2c.md.jinja"),
            **summary,
            points_interval=self.points_interval,
            start=summary["traces"]["s-gp"]["analytical"],
            found=f"within {MASS_BOUND} kg and {1000 * CENTER_BOUND:g} mm from",
            rows=rows,
            verdicts=verdicts,
            estimates=intervals,
        )


def _found_at(trace: Mapping[str, Any]) -> int | None:
    """The iteration from which on both errors stay within their bounds."""
    good = [
        abs(mass) <= MASS_BOUND and center <= CENTER_BOUND
        for mass, center in zip(trace["mass_error"], trace["center_error"], strict=True)
    ]
    first = max((iteration + 1 for iteration, fine in enumerate(good) if not fine), default=0)
    return first if first < len(good) else None
