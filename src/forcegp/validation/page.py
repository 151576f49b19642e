"""The page of a comparison: every number on it comes from the document of results."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from forcegp.evaluation.metrics import formatted, markdown_table, number
from forcegp.evaluation.pages import alike, rendered
from forcegp.validation.paired_tests import SCORES

ALT_TEXTS = {
    "errors": "Errors of accelerations and in force space, by joint and model",
    "calibration": "Calibration of the intervals",
    "motions": "Errors of predicted motions against their length",
}

WORTH_PREDICTING = 0.7
"""Force-space error of the best model over that of no acceleration, above which the score says nothing."""


def page(document: Mapping[str, Any]) -> str:
    """Markdown: what was done, the conclusions, tables with the best marked, and what failed."""
    models = document["models"]
    finished = {name: model for name, model in models.items() if model["runs"]}
    tables: dict[str, Any] = {}
    if finished:
        tables = {
            "overall": _overall(finished, document),
            "outside": _range(finished),
            "by_joint": _by_joint(finished, document),
            "at_rest": _at_rest(finished, document),
            "motions": _motions(finished, document),
        }
    return rendered(
        Path(__file__).with_name("report.md.jinja"),
        **document,
        **tables,
        finished=finished,
        noise_of_identifications=any("noise" in (run["result"] or {}) for run in document["identifications"]),
        taken=[[SCORES[score], f"**{each['model']}**", each["why"]] for score, each in document["winners"].items()],
        rivals=_against_baseline(document["against_baseline"]),
        alt_texts=ALT_TEXTS,
        listed=[[name, model["kind"], model["summary"], str(model["runs"])] for name, model in models.items()],
        failures=_failures(models, document),
        warnings=[
            f"{name} ({len(found)}): {found[0][0]}"
            for name, model in models.items()
            for found in alike((text, name) for text in model["warnings"])
        ],
    )


def _against_baseline(found: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if found is None or not found["models"]:
        return None
    models: Mapping[str, Mapping[str, Any]] = found["models"]
    verdicts = {name: {answer["verdict"] for answer in each.values() if answer} for name, each in models.items()}
    return {
        "head": ["model", *(f"{words}, {'difference' if s == 'nlpd' else 'ratio'}" for s, words in SCORES.items())],
        "rows": [[name, *(_against(answers[score]) for score in SCORES)] for name, answers in models.items()],
        "better": [name for name, outcomes in verdicts.items() if outcomes <= {"better"}],
        "worse": [name for name, outcomes in verdicts.items() if outcomes <= {"worse"}],
        "never_better": [name for name, outcomes in verdicts.items() if "better" not in outcomes],
    }


def _against(answer: Mapping[str, Any] | None) -> str:
    if answer is None:
        return "–"
    sign = "+" if answer["score"] == "nlpd" else ""
    value = f"{answer['value']:{sign}.3g}"
    value = f"**{value}**" if answer["verdict"] == "better" else value
    if answer["interval"] is None:
        return value
    low, high = answer["interval"]
    return f"{value} ({low:{sign}.3g}–{high:{sign}.3g})" if not sign else f"{value} ({low:+.3g} to {high:+.3g})"


def _overall(models: Mapping[str, Any], document: Mapping[str, Any]) -> str:
    force = unit_of(document, "u")
    header = ["model", "nRMSE", f"force error [{force}], rms", "mean abs", "NLPD [nats]"]
    header += ["in 95 %", "in 50 %", "fit [CPU s]"]
    errors, levels = ("nrmse", "force_rms", "force_mae", "nlpd"), {"coverage_95": 0.95, "coverage_50": 0.5}
    best = {s: _least((model[s] for model in models.values()), levels.get(s)) for s in (*errors, *levels)}
    rows = []
    for name, model in models.items():
        cells = [_marked(model[score], 3, best[score]) for score in errors]
        cells += [_percent(model[score], best[score]) for score in levels]
        rows.append([_named(name, model), *cells, formatted(model["cpu_seconds"], 1)])
    return markdown_table(header, rows)


def _range(models: Mapping[str, Any]) -> dict[str, Any] | None:
    """Held-out rows beyond the positions or velocities of all training rows, apart from the others."""
    apart = {name: model["range"] for name, model in models.items() if "outside" in model["range"]}
    if not apart:
        return None
    sides = [side for side in ("inside", "outside") if all(side in found for found in apart.values())]
    header = ["model", *(f"{word}, {side}" for side in sides for word in ("nRMSE", "in 95 %"))]
    rows = []
    for name, found in apart.items():
        shown = [(formatted(found[side]["nrmse"], 3), _percent(found[side]["coverage_95"])) for side in sides]
        rows.append([name, *(cell for pair in shown for cell in pair)])
    count = next(iter(apart.values()))["outside"]["rows"]["median"]
    return {"count": count, "table": markdown_table(header, rows)}


def _by_joint(models: Mapping[str, Any], document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Score, title and table."""
    force = unit_of(document, "u")
    scores = (
        ("nrmse_per_joint", "Normalised error of the acceleration (RMSE / standard deviation of the target)", 3),
        ("force_rms_per_joint", f"Force-space error, rms [{force}]", 3),
        ("force_mae_per_joint", f"Force-space error, mean absolute [{force}]", 3),
        ("nlpd_per_joint", "Negative log predictive density [nats]", 2),
    )
    parts = [(score, title, _joint_table(models, document, score, digits)) for score, title, digits in scores]
    for level in (95, 50):
        score = f"coverage_{level}_per_joint"
        rows = [[_named(name, model), *(_percent(value) for value in model[score])] for name, model in models.items()]
        table = markdown_table(["model", *document["joint_names"]], rows)
        parts.append((score, f"Held-out rows inside the {level} % interval", table))
    return parts


def _at_rest(models: Mapping[str, Any], document: Mapping[str, Any]) -> dict[str, Any] | None:
    """What predicting no acceleration would score, and the joints where the best model is hardly better than that."""
    rest = next((m["force_rms_at_rest_per_joint"] for m in models.values() if "force_rms_at_rest_per_joint" in m), None)
    if rest is None:
        return None
    best = [_least(model["force_rms_per_joint"][joint] for model in models.values()) for joint in range(len(rest))]
    names = document["joint_names"]
    empty = [
        name
        for name, least, value in zip(names, best, rest, strict=True)
        if least is not None and least > WORTH_PREDICTING * value["median"]
    ]
    levels = (f"{name} {value['median']:.3g}" for name, value in zip(names, rest, strict=True))
    return {"levels": ", ".join(levels), "empty": empty}


def _joint_table(models: Mapping[str, Any], document: Mapping[str, Any], score: str, digits: int) -> str:
    best = [_least(model[score][joint] for model in models.values()) for joint in range(len(document["joint_names"]))]
    rows = [
        [_named(name, model), *(_marked(value, digits, least) for value, least in zip(model[score], best, strict=True))]
        for name, model in models.items()
    ]
    return markdown_table(["model", *document["joint_names"]], rows)


def _motions(models: Mapping[str, Any], document: Mapping[str, Any]) -> dict[str, Any] | None:
    moving = {name: model for name, model in models.items() if model["motions"] is not None}
    if not moving:
        return None
    first = next(iter(moving.values()))["motions"]
    places = range(len(first["horizons"]))
    fewest = [min(model["motions"]["diverged"][k] for model in moving.values()) for k in places]
    best = [
        _least(m["motions"]["rms"][k] for m in moving.values() if m["motions"]["diverged"][k] == fewest[k])
        for k in places
    ]
    rows = []
    for name, model in moving.items():
        motions, cells = model["motions"], []
        for k in places:
            lost = motions["diverged"][k]
            cell = _marked(motions["rms"][k], 4, best[k] if lost == fewest[k] else None)
            cells.append(f"{cell}, {lost} of {motions['motions']} diverged" if lost else cell)
        rows.append([_named(name, model), *cells])
    at_last = {name: {**model, "at": model["motions"]["rms_per_joint"][-1]} for name, model in moving.items()}
    return {
        "unit": unit_of(document, "q"),
        **{name: first[name] for name in ("integrator", "dt")},
        "table": markdown_table(["model", *(f"after {h:g} s" for h in first["horizons"])], rows),
        "last": first["horizons"][-1],
        "by_joint": _joint_table(at_last, document, "at", 4),
    }


def _failures(models: Mapping[str, Any], document: Mapping[str, Any]) -> list[str]:
    lines = []
    for name, model in models.items():
        for reason, runs in _reasons(model["failures"]).items():
            of = model["runs"] + len(model["failures"])
            lines.append(f"**{name}** failed in {len(runs)} of {of} runs ({'; '.join(runs)}): {reason}")
    failed = [run for run in document["identifications"] if run["error"] is not None]
    for name in dict.fromkeys(run["name"] for run in failed):
        for reason, runs in _reasons(run for run in failed if run["name"] == name).items():
            lines.append(f"the {name} identification failed ({'; '.join(runs)}): {reason}")
    return lines


def _reasons(failed: Iterable[Mapping[str, Any]]) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for run in failed:
        groups.setdefault(run["error"], []).append(f"{run['split']}, seed {run['seed']}")
    return groups


def _named(name: str, model: Mapping[str, Any]) -> str:
    failed = len(model["failures"])
    return f"{name} ({model['runs']} of {model['runs'] + failed} runs)" if failed else name


def _least(values: Iterable[Mapping[str, Any] | None], level: float | None = None) -> float | None:
    """The best median: the least, or the nearest to a level."""
    medians = (value["median"] for value in values if value is not None)
    return min(medians, key=lambda median: median if level is None else abs(median - level), default=None)


def _marked(value: Mapping[str, Any] | None, digits: int, best: float | None) -> str:
    """With the median in bold where it is the best."""
    text = formatted(value, digits)
    if value is None or best is None or value["median"] != best:
        return text
    median = number(value["median"], digits)
    return f"**{median}**{text.removeprefix(median)}"


def _percent(value: Mapping[str, Any] | None, best: float | None = None) -> str:
    if value is None:
        return "–"
    in_percent = {name: 100.0 * value[name] for name in ("median", "min", "max")} | {"values": value["values"]}
    return _marked(in_percent, 1, None if best is None else 100.0 * best) + " %"


def unit_of(document: Mapping[str, Any], quantity: str) -> str:
    """`Nm`, or `Nm or N` where joints differ."""
    units = document["units"][quantity]
    return units if isinstance(units, str) else " or ".join(dict.fromkeys(units))
