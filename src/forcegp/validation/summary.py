"""Results of the finished pieces of a comparison: medians and ranges over seeds and splits, as plain JSON values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from forcegp.errors import FileFormatError
from forcegp.evaluation.summary_statistics import median_and_range
from forcegp.validation.candidates import Candidate
from forcegp.validation.scores import over_joints

Result = Mapping[str, Any]


def summary_of(runs: Mapping[str, Sequence[Mapping[str, Any]]], models: Mapping[str, Candidate]) -> dict[str, Any]:
    """By model: what it is, spreads of its scores, and why runs failed.

    `runs` holds what was kept of every model, one for each split and seed. Over joints see `scores.over_joints`.
    Raises FileFormatError where runs used different mass matrices for their force errors.
    """
    for split in {run["split"] for each in runs.values() for run in each}:
        used = {
            run["result"]["mass_matrix"]
            for each in runs.values()
            for run in each
            if run["result"] is not None and run["split"] == split
        }
        if len(used) > 1:
            raise FileFormatError(
                f"force errors of split {split!r} rest on different mass matrices ({'; '.join(sorted(used))}); "
                "delete the folder of jobs and run the same command again."
            )
    return {name: _model(runs[name], models[name]) for name in models}


def _model(runs: Sequence[Mapping[str, Any]], candidate: Candidate) -> dict[str, Any]:
    results = [run["result"] for run in runs if run["result"] is not None]
    failures = [
        {"split": run["split"], "seed": run["seed"], "error": run["error"]} for run in runs if run["result"] is None
    ]
    out: dict[str, Any] = {
        "kind": candidate.kind,
        "summary": candidate.summary,
        "runs": len(results),
        "failures": failures,
        "warnings": sorted({warning for run in runs for warning in run["warnings"]}),
    }
    if not results:
        return out
    for score in ("nrmse", "rmse", "mae", "force_rms", "force_mae"):
        out[score] = median_and_range(over_joints(score, result[score]) for result in results)
        out[f"{score}_per_joint"] = _per_joint(results, lambda result, score=score: result[score])
    if all("force_rms_at_rest" in result for result in results):
        out["force_rms_at_rest_per_joint"] = _per_joint(results, lambda result: result["force_rms_at_rest"])
    for score in ("nlpd", "cpu_seconds"):
        out[score] = median_and_range(result[score] for result in results)
    out["nlpd_per_joint"] = _per_joint(results, lambda result: result["nlpd_per_joint"])
    levels = results[0]["levels"]
    for level in (0.5, 0.95):
        place = levels.index(level)
        name = f"coverage_{round(100 * level)}"
        out[name] = _covered(results, place)
        out[f"{name}_per_joint"] = _per_joint(results, lambda result, place=place: result["coverage"][place])
    out["calibration"] = {
        "levels": levels,
        "covered": [
            median_and_range(over_joints("coverage", result["coverage"][place]) for result in results)
            for place in range(len(levels))
        ],
    }
    out["motions"] = _motions([result["motions"] for result in results])
    return out


def _covered(results: Sequence[Result], place: int) -> dict[str, Any] | None:
    return median_and_range(over_joints("coverage", result["coverage"][place]) for result in results)


def _motions(runs: Sequence[Mapping[str, Any] | None]) -> dict[str, Any] | None:
    """Spreads at every horizon that all runs have; `diverged` counts over runs, of `motions` in all."""
    given = [run for run in runs if run is not None]
    if not given or len(given) < len(runs):
        return None
    horizons = [h for h in given[0]["horizons"] if all(h in run["horizons"] for run in given)]
    places = [[run["horizons"].index(h) for run in given] for h in horizons]
    return {
        "horizons": horizons,
        "motions": sum(run["motions"] for run in given),
        "integrator": given[0]["integrator"],
        "dt": given[0]["dt"],
        "rms": [median_and_range(run["rms"][at] for run, at in zip(given, here, strict=True)) for here in places],
        "rms_per_joint": [
            [
                median_and_range(run["rms_per_joint"][at][joint] for run, at in zip(given, here, strict=True))
                for joint in range(len(given[0]["rms_per_joint"][0]))
            ]
            for here in places
        ],
        "diverged": [sum(run["diverged"][at] for run, at in zip(given, here, strict=True)) for here in places],
    }


def _per_joint(results: Sequence[Result], values: Callable[[Result], Sequence[float | None]]) -> list[Any]:
    return [median_and_range(values(result)[joint] for result in results) for joint in range(len(values(results[0])))]
