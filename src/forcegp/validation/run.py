"""`validate`: compute what is missing of a comparison, and write its page, figures and numbers."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import forcegp.evaluation
import forcegp.validation
from forcegp import __version__
from forcegp.atomic_files import write_json, write_text
from forcegp.data import preparation_report
from forcegp.errors import FileFormatError, InvalidInput, require_type
from forcegp.evaluation.metrics import median_and_range
from forcegp.jobs import JobStore, Progress, run_jobs
from forcegp.jobs.job import machine
from forcegp.parallel import checked_jobs
from forcegp.validation.candidates import Candidate, candidates, default_models
from forcegp.validation.comparison import Comparison
from forcegp.validation.jobs import jobs_of, kept
from forcegp.validation.page import page
from forcegp.validation.paired_tests import MARGIN, against_baseline, conclusions, winners
from forcegp.validation.scores import over_joints


def preparation_lines(metadata: Mapping[str, Any]) -> list[str]:
    """`metadata["preparation"]` of a Dataset (`data.Preparation`) as sentences, the last step first."""
    report = preparation_report(metadata)
    if not report:
        return ["Preparation: none stated; q, v, u and a are scored as the dataset holds them."]
    lines = [f"Preparation: {_step(report)}"]
    removed = report.get("power_removed")
    if isinstance(removed, Mapping) and removed.get("a"):
        shares = ", ".join("–" if share is None else f"{100.0 * share:.3g} %" for share in removed["a"])
        lines.append(
            f"The filter took {shares} of the variance of the joints' acceleration; scores are against the rest."
        )
    for quantity, reason in dict(report.get("why") or {}).items():
        told = "; ".join(f"{name} {why}" for name, why in reason.items()) if isinstance(reason, Mapping) else reason
        lines.append(f"Chosen automatically, {quantity}: {told}")
    earlier = report.get("earlier")
    return lines + (preparation_lines({"preparation": earlier}) if preparation_report({"preparation": earlier}) else [])


def _step(report: Mapping[str, Any]) -> str:
    parts = []
    for name, what in (("delay", "u taken from {} ms later"), ("lag", "u through actuators of first order, {} ms")):
        each = [float(value) for value in report.get(name) or []]
        if any(each):
            shown = each if len(set(each)) > 1 else each[:1]
            parts.append(what.format(", ".join(f"{1e3 * value:.3g}" for value in shown)))
    cutoff = report.get("cutoff")
    if cutoff is None:
        parts.append("no filter")
    else:
        source = report.get("differentiate")
        made = "v and a from it by central differences" if source == "q" else "a from v by central differences"
        what = "q and u" if source == "q" else "q, v and u"
        parts.append(
            f"zero-phase Butterworth low-pass of order {report.get('order')} at {cutoff:g} Hz on {what}, {made}"
        )
    if report.get("every", 1) > 1:
        every = report["every"]
        ending = "th" if every % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(every % 10, "th")
        parts.append(f"every {every}{ending} row")
    if report.get("trim"):
        parts.append(f"{report['trim']:g} s dropped at both ends of every episode")
    return "; ".join(parts) + "."


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
        out[score] = _spread([over_joints(score, result[score]) for result in results])
        out[f"{score}_per_joint"] = _spread([result[score] for result in results])
    if all("force_rms_at_rest" in result for result in results):
        out["force_rms_at_rest_per_joint"] = _spread([result["force_rms_at_rest"] for result in results])
    for score in ("nlpd", "cpu_seconds", "nlpd_per_joint"):
        out[score] = _spread([result[score] for result in results])
    levels = results[0]["levels"]
    covered = _spread([[over_joints("coverage", each) for each in result["coverage"]] for result in results])
    by_joint = _spread([result["coverage"] for result in results])
    for level in (0.5, 0.95):
        place, name = levels.index(level), f"coverage_{round(100 * level)}"
        out[name], out[f"{name}_per_joint"] = covered[place], by_joint[place]
    out["calibration"] = {"levels": levels, "covered": covered}
    apart = [result["range"] for result in results]
    out["range"] = {
        name: {score: _spread([each[name][score] for each in apart]) for score in ("rows", "nrmse", "coverage_95")}
        for name in ("inside", "outside")
        if all(name in each for each in apart)
    }
    out["motions"] = _motions([result["motions"] for result in results])
    return out


def _motions(runs: Sequence[Mapping[str, Any] | None]) -> dict[str, Any] | None:
    """Spreads at every horizon that all runs have; `diverged` counts over runs, of `motions` in all."""
    given = [run for run in runs if run is not None]
    if not given or len(given) < len(runs):
        return None
    horizons = [h for h in given[0]["horizons"] if all(h in run["horizons"] for run in given)]
    rms, per_joint, diverged = (
        [[run[name][run["horizons"].index(h)] for h in horizons] for run in given]
        for name in ("rms", "rms_per_joint", "diverged")
    )
    return {
        "horizons": horizons,
        "motions": sum(run["motions"] for run in given),
        "integrator": given[0]["integrator"],
        "dt": given[0]["dt"],
        "rms": _spread(rms),
        "rms_per_joint": _spread(per_joint),
        "diverged": [sum(each) for each in zip(*diverged, strict=True)],
    }


def _spread(values: Sequence[Any]) -> Any:
    """`median_and_range` of what runs found; of lists, place by place."""
    if isinstance(values[0], Sequence):
        return [_spread(each) for each in zip(*values, strict=True)]
    return median_and_range(values)


KIND = "forcegp validate"
RESULTS, PAGE = "results.json", "report.md"


@dataclass(frozen=True)
class Validation:
    """What was found: `document` is all of results.json, `folder` where everything lies."""

    folder: Path
    document: Mapping[str, Any]

    @property
    def verdicts(self) -> list[str]:
        """A sentence for every question and score."""
        return [
            f"{item['question']} {answer['sentence']}"
            for item in self.document["verdicts"]
            for answer in item["answers"]
        ]


def validate(
    comparison: Comparison,
    folder: str | Path,
    *,
    models: Sequence[str] | None = None,
    seeds: int = 5,
    jobs: int | Executor = 1,
    source: Mapping[str, Any] | None = None,
    margin: float = MARGIN,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Validation:
    """Fit every model for every split and seed, score it on the rows held out, and write one page about all of them.

    Every finished piece is kept in `folder/jobs` at once; the same call goes on after an interruption, and one with
    more models or seeds computes only these. A model that fails is a row that names the error.

    Parameters
    ----------
    models: names as in `validation.candidates`; None takes its `default_models`.
    seeds: how many choices of training rows, numbered from 0.
    jobs: pieces at once, in as many processes of this machine, or an executor in which they run.
    source: where the data come from, for the page: "title", and "data", a list of lines; plain JSON values.
    margin: ratios of errors within it of 1 count as no difference.
    overwrite: compute everything anew, also where the folder holds results.

    Raises
    ------
    InvalidInput: an argument is out of range, the folder holds something else, or another process is at work there.
    """
    require_type("comparison", comparison, Comparison)
    checked_jobs(jobs)
    if isinstance(seeds, bool) or seeds < 1:
        raise InvalidInput(f"the number of seeds is {seeds}; it must be at least 1.")
    if not 0.0 <= margin < 1.0:
        raise InvalidInput(f"the margin is {margin:g}; it must be at least 0 and below 1, such as {MARGIN}.")
    named = default_models(comparison.model) if models is None else models
    assert comparison.identification is not None, "it is resolved"
    chosen = candidates(named, comparison.model, comparison.identification)
    configuration = comparison.configuration()
    store = JobStore.open(Path(folder), KIND, configuration, overwrite=overwrite)
    identifications, fits = jobs_of(comparison, chosen, seeds)
    run_jobs(store, [*identifications, *fits], jobs, progress)
    runs = {name: [kept(store, job.name) for job in fits if job.spec["name"] == name] for name in chosen}
    for name in (name for name, model in chosen.items() if model.all_rows):
        runs[name] = [{**run, "seed": seed} for seed in range(seeds) for run in runs[name]]
    document = _document(comparison, runs, chosen, seeds, margin)
    document |= {"configuration": {"forcegp": __version__, **configuration}, "source": dict(source or {})}
    document["identifications"] = [_brief(kept(store, job.name)) for job in identifications]
    with store.locked():
        figures = forcegp.validation.figures_of(document)
        for name, figure in figures.items():
            forcegp.evaluation.save_figure(figure, store.folder / f"{name}.png")
        document["figures"] = sorted(figures)
        write_json(store.folder / RESULTS, document)
        write_text(store.folder / PAGE, page(document))
    return Validation(store.folder, document)


def _document(
    comparison: Comparison,
    runs: Mapping[str, Sequence[Mapping[str, Any]]],
    chosen: Mapping[str, Any],
    seeds: int,
    margin: float,
) -> dict[str, Any]:
    summary = summary_of(runs, chosen)
    units = {name: comparison.rows.units[name] for name in ("q", "u", "a")}
    splits = []
    for split in comparison.splits:
        (train, test), motions = split.apply(comparison.rows), comparison.motions(split)
        count = 0 if motions.motions is None else len(motions.motions.q)
        sides = {"training_rows": len(train), "test_rows": len(test), "motions": count, "notes": list(motions.notes)}
        splits.append(split.to_dict() | sides)
    return {
        "kind": "forcegp validate",
        "machine": machine(),
        "joint_names": list(comparison.rows.joint_names),
        "units": {name: unit if isinstance(unit, str) else list(unit) for name, unit in units.items()},
        "preparation": preparation_lines(comparison.rows.metadata),
        "splits": splits,
        "rows": len(comparison.rows),
        "points": comparison.points,
        "seeds": list(range(seeds)),
        "mass_matrix": sorted(
            {run["result"]["mass_matrix"] for each in runs.values() for run in each if run["result"] is not None}
        ),
        "models": summary,
        "margin": margin,
        "winners": winners(summary, runs, margin),
        "verdicts": conclusions(summary, runs, margin),
        "against_baseline": against_baseline(summary, runs, margin),
        "runs": {name: [_brief(run) for run in each] for name, each in runs.items()},
    }


def _brief(run: Mapping[str, Any]) -> dict[str, Any]:
    """Without the model of an identification, which its own file holds."""
    result = run["result"]
    if run["kind"] == "identification" and result is not None:
        result = {name: value for name, value in result.items() if name != "model"}
    return {**run, "result": result}
