"""Figure 4: motions that the models predict, from the same initial states, over seconds."""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from typing_extensions import override

from benchmarks.paper.experiment import Experiment, Row, in_columns, stored_arrays
from benchmarks.paper.fig4_jobs import ARRAYS, CONTROLS, FREQUENCY, VARIANTS
from benchmarks.paper.figures import rollouts_figure
from benchmarks.paper.fits import GAUSSIAN_PROCESSES, MODELS, FitSettings, fit_series
from forcegp.jobs import Job, JobStore
from forcegp.scores.accuracy import median_and_range
from forcegp.scores.page import number, rendered

TASKS = "benchmarks.paper.fig4_jobs"
_name = "fig4/{}/{}/{}/seed{}".format  # control, variant, model, seed
_truth_name = "fig4/truth/seed{}".format
BLACK_BOXES = ("gp",)
WITHOUT_CONSTRAINT = ("none",)  # variants of models without a constraint, and so cannot be stabilised by it


@dataclass(frozen=True)
class Fig4(Experiment):
    """`starts` initial states from the test trajectory of each seed, with its recorded torques, for `seconds`."""

    name, title = "fig4", "Figure 4: roll-outs"

    points: tuple[int, ...]
    seeds: tuple[int, ...]
    starts: int
    seconds: tuple[float, ...]
    settings: FitSettings
    models: tuple[str, ...] = GAUSSIAN_PROCESSES

    @override
    def jobs(self) -> list[Job]:
        out: list[Job] = []
        for seed in self.seeds:
            data = self.data.job(seed)
            rolled = {"data": data.name, "starts": self.starts, "seconds": list(self.seconds)}
            out += [data, Job(_truth_name(seed), f"{TASKS}:truth", rolled, (data.name,), 20.0)]
            for model in self.models:
                series = fit_series(model, data.name, seed, self.points, self.settings)
                out += series
                fit = series[-1].name
                for control in CONTROLS:
                    for variant in variants_of(model):
                        spec = {**rolled, "fit": fit, "control": control, "variant": variant}
                        out.append(Job(_name(control, variant, model, seed), f"{TASKS}:roll", spec, (fit,), 10.0))
        return out

    @override
    def summary(self, results: JobStore) -> dict[str, Any]:
        motions: dict[str, Any] = {
            control: {
                variant: {
                    model: self._together([results.result(_name(control, variant, model, seed)) for seed in self.seeds])
                    for model in self.models
                    if variant in variants_of(model)
                }
                for variant in VARIANTS
            }
            for control in CONTROLS
        }
        true = [results.result(_truth_name(seed)) for seed in self.seeds]
        twins = {
            size: {second: _spread([x for each in true for x in each["joint_error"][size][second]]) for second in rows}
            for size, rows in true[0]["joint_error"].items()
        }
        recorded = {
            "largest": max(each["recorded_constraint"]["largest"] for each in true),
            "median": float(np.median([each["recorded_constraint"]["median"] for each in true])),
        }
        return {"points": max(self.points), "motions": motions, "recorded_constraint": recorded, "truth": twins}

    def _together(self, found: list[dict[str, Any]]) -> dict[str, Any]:
        """Scores of all seeds' motions as one."""
        out: dict[str, Any] = {"diverged": sum(job["diverged"] for job in found)}
        for second in self.seconds:
            parts = [job["scores"][f"{second:g}"] for job in found]
            out[f"{second:g}"] = {
                "joint_error": _spread([error for part in parts for error in part["joint_error"]]),
                "constraint": median_and_range(value for part in parts for value in part["constraint_median"]),
                "constraint_largest": max(max(part["constraint_largest"]) for part in parts),
            }
        return out

    def _first_median(self, summary: Mapping[str, Any], model: str) -> float | None:
        """Open loop, the first of `seconds`; None if it diverged, or is not part of this experiment."""
        scores = summary["motions"]["open-loop"][variants_of(model)[0]].get(model)
        return None if scores is None else scores[f"{self.seconds[0]:g}"]["joint_error"]["median"]

    @override
    def rows(self, summary: Mapping[str, Any]) -> list[Row]:
        out: list[Row] = []
        for control, variants in summary["motions"].items():
            for variant, model, scores in _each(variants):
                row: Row = {"control": control, "stabilisation": VARIANTS[variant], "model": MODELS[model].label}
                for second in self.seconds:
                    score = scores[f"{second:g}"]
                    row |= in_columns({f"{name}_{second:g}s": score[name] for name in ("joint_error", "constraint")})
                    row[f"constraint_largest_{second:g}s"] = score["constraint_largest"]
                out.append(row | {"diverged": scores["diverged"]})
        return out

    @override
    def figures(self, summary: Mapping[str, Any], results: JobStore) -> dict[str, Figure]:
        figures = {}
        for control in CONTROLS:
            arrays: dict[str, dict[str, dict[str, np.ndarray]]] = {variant: {} for variant in VARIANTS}
            for variant, model, _ in _each(summary["motions"][control]):
                parts = [stored_arrays(results, _name(control, variant, model, seed), ARRAYS) for seed in self.seeds]
                arrays[variant][model] = {
                    name: parts[0][name] if name == "time" else np.concatenate([part[name] for part in parts])
                    for name in parts[0]
                }
            figures[f"fig4-{control}"] = rollouts_figure(arrays, CONTROLS[control])
        return figures

    @override
    def section(self, summary: Mapping[str, Any]) -> str:
        count = self.starts * len(self.seeds)
        seconds = [f"{second:g}" for second in self.seconds]
        columns: dict[tuple[str, str], Callable[[Mapping[str, Any]], str]] = {
            ("joint error", "rad"): lambda score: _error(score["joint_error"]),
            ("median \\|c(q)\\|", "m"): lambda score: number(score["constraint"]["median"]),
            ("largest", "m"): lambda score: number(score["constraint_largest"]),
        }
        tables = []
        for control, title in CONTROLS.items():
            rows = []
            for variant, model, scores in _each(summary["motions"][control]):
                cells = [cell(scores[second]) for cell in columns.values() for second in seconds]
                label = f"{MODELS[model].label}, {VARIANTS[variant]}"
                rows.append([label, *cells, f"{scores['diverged']} of {count}"])
            tables.append((title, rows))
        twins = {
            "head": ["change [rad]", *(f"joint error after {second} s [rad]" for second in seconds)],
            "rows": [[size, *(_error(errors[s]) for s in seconds)] for size, errors in summary["truth"].items()],
        }
        header = (f"{name}, {second} s [{unit}]" for name, unit in columns for second in seconds)
        return rendered(
            Path(__file__).with_name("fig4.md.jinja"),
            **summary,
            count=count,
            starts=self.starts,
            seeds=len(self.seeds),
            twins=twins,
            frequency=FREQUENCY,
            head=["model", *header, "diverged"],
            tables=tables,
            gp=self._first_median(summary, "gp"),
            mean=self._first_median(summary, "s-gp-mean"),
            first_second=seconds[0],
        )


def variants_of(model: str) -> tuple[str, ...]:
    """How this model's constraint is kept."""
    return WITHOUT_CONSTRAINT if model in BLACK_BOXES else tuple(VARIANTS)


def _each(variants: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str, Mapping[str, Any]]]:
    return [(variant, model, scores) for variant, models in variants.items() for model, scores in models.items()]


def _spread(errors: Sequence[float | None]) -> dict[str, Any]:
    """Median and range of errors of which None is infinite (diverged); the median of an even number is the larger one.

    What is infinite is None in the result, too.
    """
    ordered = sorted(math.inf if error is None else error for error in errors)
    parts = {"median": statistics.median_high(ordered), "min": ordered[0], "max": ordered[-1]}
    return {**{name: x if math.isfinite(x) else None for name, x in parts.items()}, "values": list(errors)}


def _error(error: Mapping[str, Any]) -> str:
    """`.0831 (.0825–∞)`: motions that diverged are infinite."""
    median, least, largest = ("∞" if error[part] is None else number(error[part]) for part in ("median", "min", "max"))
    return f"{median} ({least}–{largest})"
