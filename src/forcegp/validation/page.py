"""The page of a comparison: every number on it comes from the document of results."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from forcegp.evaluation.metrics import formatted, markdown_table, number
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
    source = document["source"]
    parts = [f"# Validation{' of ' + source['title'] if source.get('title') else ''}", *_done(document)]
    parts += ["## Conclusions", *_winners(document["winners"]), _conclusions(document)]
    parts += _against_baseline(document["against_baseline"])
    if finished:
        parts += ["## All joints", _overall(finished, document)]
        parts += [f"![{ALT_TEXTS[name]}]({name}.png)" for name in document["figures"]]
        parts += _range(finished)
        parts += ["## By joint", *_by_joint(finished, document)]
        parts += ["## Predicted motions", _motions(finished, document)]
    rows = [[name, model["kind"], model["summary"], str(model["runs"])] for name, model in models.items()]
    parts += ["## Models", markdown_table(["model", "kind", "what it is", "finished runs"], rows)]
    parts += _failures(models, document)
    parts += _warnings(models)
    made = f"forcegp {document['configuration']['forcegp']}; {document['machine']}."
    parts += ["## Where", f"{made} All numbers, with what decides them: `results.json`."]
    return "\n\n".join(parts) + "\n"


def _done(document: Mapping[str, Any]) -> list[str]:
    source, seeds = document["source"], len(document["seeds"])
    lines = [f"* Data: {line}" for line in source.get("data", [])]
    lines += [f"* {line}" for line in document["preparation"]]
    for split in document["splits"]:
        sides = (
            f"{split['training_rows']} rows to learn from, {split['test_rows']} held out, {split['motions']} motions"
        )
        lines.append(f"* Split: {split['words']} ({sides}).")
        lines += [f"* {note[0].upper()}{note[1:]}" for note in split["notes"]]
    lines.append(
        f"* Models learn from the same {document['points']} rows: those that lie farthest apart among two thirds of "
        f"the training rows, drawn anew for each of {seeds} seed{'s' if seeds > 1 else ''}. All training rows are used "
        "by identifications that say so, by functions of one or two inputs, as friction of the joints, and by what is "
        "refined on motions. Tables show the median over runs (seeds and splits) and the range from the best to the "
        "worst."
    )
    lines.append(
        "* Noise: learned by every model from the same start, what the data state or else a tenth of the scatter of "
        "each joint's acceleration among the training rows; networks estimate their own. Intervals and densities are "
        "those of measurements."
    )
    laws = ", ".join(document["configuration"]["friction"]) or "none"
    lines.append(f"* Friction that identifications estimate: {laws}.")
    force_noise = document["configuration"]["force_noise"]
    if force_noise is not None:
        lines.append(f"* Models with physics learn a noise of the joint forces as well, from {force_noise:g} on.")
    if any("noise" in (run["result"] or {}) for run in document["identifications"]):
        lines.append(
            "* Models that rest on an identification of all training rows do not learn their noise: they have that of "
            "accelerations and forces about stretches of training rows, each predicted by a system identified from the "
            "others (block cross-validation)."
        )
    if document["configuration"]["measured_torque"]:
        lines.append(
            "* Where models have a noise of forces, it is that of measured torques: the u of a prediction is as noisy, "
            "and accelerations that only this noise explains are shrunk."
        )
    whose = "; ".join(document["mass_matrix"]) or "none, since no model finished"
    lines.append(
        f"* Force-space error: M (predicted − measured acceleration) with one M for all models: of {whose}. Where M is "
        "small, a small force is a large acceleration, so an error of acceleration alone can mislead. It is no error "
        "of a torque: a model that shrinks accelerations scores well where they are small."
    )
    return ["\n".join(lines)]


def _winners(found: Mapping[str, Mapping[str, str]]) -> list[str]:
    rows = [[SCORES[score], f"**{each['model']}**", each["why"]] for score, each in found.items()]
    return [markdown_table(["by the", "take", "because"], rows)] if rows else []


def _conclusions(document: Mapping[str, Any]) -> str:
    found = document["verdicts"]
    if not found:
        return "There are no two finished models to compare for any question."
    lines = []
    for item in found:
        lines.append(f"* {item['question']}")
        lines += [f"  * {answer['sentence']}" for answer in item["answers"]]
    lines.append(
        "\nOf each kind the model with the lowest error is taken, which favours kinds with many models a little. Pairs "
        "share their training rows and held-out rows. Intervals are for other held-out stretches of time and other "
        "choices of training rows, of recordings like this one; ratios within "
        f"{100.0 * document['margin']:g} % of 1 count as no difference."
    )
    return "\n".join(lines)


def _against_baseline(found: Mapping[str, Any] | None) -> list[str]:
    if found is None or not found["models"]:
        return []
    models: Mapping[str, Mapping[str, Any]] = found["models"]
    rows = [[name, *(_against(answers[score]) for score in SCORES)] for name, answers in models.items()]
    verdicts = {name: {answer["verdict"] for answer in each.values() if answer} for name, each in models.items()}
    sentences = []
    for words, holds in (
        ("Better than it by every score", lambda outcomes: outcomes <= {"better"}),
        ("Worse than it by every score", lambda outcomes: outcomes <= {"worse"}),
        ("Not shown to be better by any score", lambda outcomes: "better" not in outcomes),
    ):
        names = [name for name, outcomes in verdicts.items() if holds(outcomes)]
        sentences.append(f"{words}: {', '.join(names) or 'none'}.")
    header = [f"{words}, {'difference' if score == 'nlpd' else 'ratio'}" for score, words in SCORES.items()]
    text = "With 95 % intervals over stretches and seeds; bold where the model is shown to be better."
    return [
        f"## Every model against {found['baseline']}",
        text,
        markdown_table(["model", *header], rows),
        " ".join(sentences),
    ]


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
    force = _listed_units(document["units"]["u"])
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


def _range(models: Mapping[str, Any]) -> list[str]:
    """Held-out rows beyond the positions or velocities of all training rows, apart from the others."""
    apart = {name: model["range"] for name, model in models.items() if "outside" in model["range"]}
    if not apart:
        return ["## Outside the training range", "No held-out row has a position or velocity beyond all training rows."]
    sides = [side for side in ("inside", "outside") if all(side in found for found in apart.values())]
    header = ["model", *(f"{word}, {side}" for side in sides for word in ("nRMSE", "in 95 %"))]
    rows = []
    for name, found in apart.items():
        shown = [(formatted(found[side]["nrmse"], 3), _percent(found[side]["coverage_95"])) for side in sides]
        rows.append([name, *(cell for pair in shown for cell in pair)])
    count = next(iter(apart.values()))["outside"]["rows"]["median"]
    text = f"{count:g} held-out rows have a joint position or velocity beyond all training rows."
    return ["## Outside the training range", text, markdown_table(header, rows)]


def _by_joint(models: Mapping[str, Any], document: Mapping[str, Any]) -> list[str]:
    force = _listed_units(document["units"]["u"])
    tables = (
        ("nrmse_per_joint", "Normalised error of the acceleration (RMSE / standard deviation of the target)", 3),
        ("force_rms_per_joint", f"Force-space error, rms [{force}]", 3),
        ("force_mae_per_joint", f"Force-space error, mean absolute [{force}]", 3),
        ("nlpd_per_joint", "Negative log predictive density [nats]", 2),
    )
    parts = []
    for score, title, digits in tables:
        parts.append(f"{title}:\n\n{_joint_table(models, document, score, digits)}")
        if score == "force_rms_per_joint":
            parts += _at_rest(models, document)
    for level in (95, 50):
        score = f"coverage_{level}_per_joint"
        rows = [[_named(name, model), *(_percent(value) for value in model[score])] for name, model in models.items()]
        table = markdown_table(["model", *document["joint_names"]], rows)
        parts.append(f"Held-out rows inside the {level} % interval:\n\n{table}")
    return parts


def _at_rest(models: Mapping[str, Any], document: Mapping[str, Any]) -> list[str]:
    """What predicting no acceleration would score, and the joints where the best model is hardly better than that."""
    rest = next((m["force_rms_at_rest_per_joint"] for m in models.values() if "force_rms_at_rest_per_joint" in m), None)
    if rest is None:
        return []
    best = [_least(model["force_rms_per_joint"][joint] for model in models.values()) for joint in range(len(rest))]
    empty = [
        name
        for name, least, value in zip(document["joint_names"], best, rest, strict=True)
        if least is not None and least > WORTH_PREDICTING * value["median"]
    ]
    levels = ", ".join(
        f"{name} {value['median']:.3g}" for name, value in zip(document["joint_names"], rest, strict=True)
    )
    sentence = f"Predicting no acceleration at all has {levels}."
    if empty:
        sentence += (
            f" At {', '.join(empty)} the best model is hardly better than that: there this score says nothing about a "
            "model, least of all how well it predicts torques."
        )
    return [sentence]


def _joint_table(models: Mapping[str, Any], document: Mapping[str, Any], score: str, digits: int) -> str:
    best = [_least(model[score][joint] for model in models.values()) for joint in range(len(document["joint_names"]))]
    rows = [
        [_named(name, model), *(_marked(value, digits, least) for value, least in zip(model[score], best, strict=True))]
        for name, model in models.items()
    ]
    return markdown_table(["model", *document["joint_names"]], rows)


def _motions(models: Mapping[str, Any], document: Mapping[str, Any]) -> str:
    moving = {name: model for name, model in models.items() if model["motions"] is not None}
    if not moving:
        return "None could be predicted: " + " ".join(note for split in document["splits"] for note in split["notes"])
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
    unit = _listed_units(document["units"]["q"])
    table = markdown_table(["model", *(f"after {h:g} s" for h in first["horizons"])], rows)
    last = first["horizons"][-1]
    at_last = {name: {**model, "at": model["motions"]["rms_per_joint"][-1]} for name, model in moving.items()}
    each = _joint_table(at_last, document, "at", 4)
    return (
        f"RMS error of q over motions and joints [{unit}]; the mean of each model integrated by {first['integrator']} "
        f"in steps of {first['dt']:.4g} s from recorded states under recorded forces. Errors are those of motions that "
        f"had not diverged.\n\n{table}\n\nBy joint after {last:g} s:\n\n{each}"
    )


def _failures(models: Mapping[str, Any], document: Mapping[str, Any]) -> list[str]:
    lines = []
    for name, model in models.items():
        for reason, runs in _reasons(model["failures"]).items():
            lines.append(f"* **{name}** failed in {len(runs)} of {_runs(model)} runs ({'; '.join(runs)}): {reason}")
    failed = [run for run in document["identifications"] if run["error"] is not None]
    for name in dict.fromkeys(run["name"] for run in failed):
        for reason, runs in _reasons(run for run in failed if run["name"] == name).items():
            lines.append(f"* the {name} identification failed ({'; '.join(runs)}): {reason}")
    return ["## Failures", "\n".join(lines)] if lines else []


def _runs(model: Mapping[str, Any]) -> int:
    return model["runs"] + len(model["failures"])


def _warnings(models: Mapping[str, Any]) -> list[str]:
    lines = []
    for name, model in models.items():
        kinds = _grouped((re.sub(r"\d[\d.e+-]*", "#", text), text) for text in model["warnings"])
        lines += [f"* {name} ({len(texts)}): {texts[0]}" for texts in kinds.values()]
    return ["## Warnings", "\n".join(lines)] if lines else []


def _reasons(failed: Iterable[Mapping[str, Any]]) -> dict[str, list[str]]:
    return _grouped((run["error"], f"{run['split']}, seed {run['seed']}") for run in failed)


def _grouped(pairs: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def _named(name: str, model: Mapping[str, Any]) -> str:
    return f"{name} ({model['runs']} of {_runs(model)} runs)" if model["failures"] else name


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


def _listed_units(units: str | Sequence[str]) -> str:
    """`Nm`, or `Nm and N` where joints differ."""
    return units if isinstance(units, str) else " and ".join(dict.fromkeys(units))
