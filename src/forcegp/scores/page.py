"""The page of scores in Markdown, and the same tables as rows of text for terminals and reports."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from forcegp.data import Preparation, preparation_report
from forcegp.scores.accuracy import ACCELERATION, ALL_JOINTS, FORCE, TRUE_ACCELERATION
from forcegp.scores.paired import CRITERIA, MARGIN, PairedDifference
from forcegp.scores.scores import Scores
from forcegp.scores.tables import formatted, markdown_table, number, rendered

Column = tuple[str, str, str, int]
"""Title, quantity, score and decimals; of a coverage in percent."""


def page(scores: Scores, figures: Sequence[tuple[str, str]] = ()) -> str:
    """Markdown: what was done, the model to take, tables, and what failed; `figures` have names and captions."""
    finished = [name for name in scores.models if scores.finished(name)]
    by_joint = [
        (title, markdown_table(["model", *scores.joint_names], joint_rows(scores, title, quantity, score, digits)))
        for title, quantity, score, digits in columns_of(scores)
        if finished and len(joint_numbers(scores, finished[0], quantity, score)) == len(scores.joint_names)
    ]
    differences = [[name, *map(_difference, each.values())] for name, each in scores.differences.items()]
    at_rest = scores.columns("rmse_at_rest", FORCE, finished[0]) if by_joint else []
    notes = [*scores.about.get("notes", ()), *(each for x in scores.about.get("splits", ()) for each in x["notes"])]
    return rendered(
        Path(__file__).with_name("report.md.jinja"),
        **{"source": {}, "preparation": [], "splits": [], "configuration": {}, **scores.about, "notes": notes},
        margin=MARGIN,
        taken=[[CRITERIA[name], f"**{each.model}**", each.sentence] for name, each in scores.winners.items()],
        rival=scores.rival,
        differences=differences,
        criteria=[f"{words}, {'difference' if name == 'density' else 'ratio'}" for name, words in CRITERIA.items()],
        overall=markdown_table(*overall(scores, "**")) if finished else "",
        at_rest=", ".join(f"{name} {number(x, 3)}" for name, x in zip(scores.joint_names, at_rest, strict=False) if x),
        by_joint=by_joint,
        figures=figures,
        listed=[[name, each["kind"], each["summary"], str(len(scores.finished(name)))]
                for name, each in scores.models.items()],
        failures=scores.failures,
        warnings=scores.warnings,
    )  # fmt: skip


BY_JOINT: tuple[Column, ...] = (
    ("MAE", ACCELERATION, "mae", 4),
    ("noise-free", TRUE_ACCELERATION, "mae", 4),
    ("RMSE", ACCELERATION, "rmse", 4),
    ("NLPD", ACCELERATION, "nlpd", 2),
    ("in 95 %", ACCELERATION, "coverage_95", 1),
    ("known physics", ACCELERATION, "known_physics_mae", 4),
)
OF_QUANTITIES = (
    ("MAE", "mae", 4),
    ("RMSE", "rmse", 4),
    ("RMSE / size", "relative_rmse", 3),
    ("in 95 %", "coverage_95", 1),
)


def joint_table(scores: Scores, model: str | None = None) -> tuple[list[str], list[list[str]]]:
    """Header and rows of one model: errors of the acceleration by joint, then of all together (NLPD: jointly)."""
    held, columns = scores.quantities(model), [[*scores.joint_names, "all joints"]]
    for _, quantity, score, digits in BY_JOINT:
        known = score in held.get(quantity, ())
        each = scores.columns(score, quantity, model) if known else [None] * len(scores.joint_names)
        whole = scores.value(score, ALL_JOINTS if score == "nlpd" else quantity, model) if known else None
        columns.append([_cell(value, score, digits, None, "") for value in (*each, whole)])
    return ["joint", *(title for title, *_ in BY_JOINT)], [list(row) for row in zip(*columns, strict=True)]


def quantity_table(scores: Scores, model: str | None = None) -> tuple[list[str], list[list[str]]]:
    """Header and rows of one model: what was scored beside accelerations, all columns together, in their units."""
    rows = []
    for name, held in scores.quantities(model).items():
        found = [
            (scores.value(score, name, model) if score in held else None, score, n) for _, score, n in OF_QUANTITIES
        ]
        if name not in (ACCELERATION, ALL_JOINTS) and any(value is not None for value, *_ in found):
            rows.append([name, *(_cell(value, score, digits, None, "") for value, score, digits in found)])
    return ["of all joints", *(title for title, *_ in OF_QUANTITIES)], rows


def columns_of(scores: Scores) -> list[Column]:
    """The scores that a page shows, as far as all models have them."""
    force, q = unit_of(scores, "u"), unit_of(scores, "q")
    wanted: list[Column] = [
        (f"MAE [{unit_of(scores, 'a')}]", ACCELERATION, "mae", 4),
        ("nRMSE", ACCELERATION, "nrmse", 3),
        (f"force error [{force}]", FORCE, "rmse", 3),
        ("NLPD [nats]", ALL_JOINTS, "nlpd", 2),
        ("in 95 %", ACCELERATION, "coverage_95", 1),
        ("in 50 %", ACCELERATION, "coverage_50", 1),
        *((f"q after {h:g} s [{q}]", f"position after {h:g} s", "rmse", 4) for h in scores.horizons),
    ]
    held = [scores.quantities(name) for name in scores.models if scores.finished(name)]
    return [each for each in wanted if all(each[2] in other.get(each[1], ()) for other in held)]


def overall(scores: Scores, mark: str = "") -> tuple[list[str], list[list[str]]]:
    """Header and one row per model, all joints together; `mark` stands on both sides of the best medians."""
    columns, rows = columns_of(scores), []
    finished = [name for name in scores.models if scores.finished(name)]
    for name, runs in scores.runs.items():
        count = len(scores.finished(name))
        row = [name if count == len(runs) else f"{name} ({count} of {len(runs)} runs)"]
        for _, quantity, score, digits in columns if count else ():
            spreads = {each: scores.spread(score, quantity, each) for each in finished}
            medians = [each["median"] for each in spreads.values() if each is not None]
            row.append(_cell(spreads[name], score, digits, _best(score, medians), mark) + _lost(scores, name, quantity))
        rows.append(row + ["–"] * (1 + len(columns) - len(row)))
    return ["model", *(title for title, *_ in columns)], rows


def joint_rows(scores: Scores, title: str, quantity: str, score: str, digits: int) -> list[list[str]]:
    """One row per finished model, one column per joint."""
    finished = [name for name in scores.models if scores.finished(name)]
    each = {name: joint_numbers(scores, name, quantity, score) for name in finished}
    best = [_best(score, [x for x in column if x is not None]) for column in zip(*each.values(), strict=True)]
    return [[name, *(_cell(x, score, digits, b, "**") for x, b in zip(numbers, best, strict=True))]
            for name, numbers in each.items()]  # fmt: skip


def joint_numbers(scores: Scores, model: str, quantity: str, score: str) -> list[float | None]:
    """By joint; densities of each joint alone."""
    return scores.columns(score, ACCELERATION if quantity == ALL_JOINTS else quantity, model)


def _best(score: str, medians: Sequence[float]) -> float | None:
    """The least, of coverages the nearest to their level."""
    level = float(score.partition("coverage_")[2] or 0.0) / 100.0
    return min(medians, key=lambda value: abs(value - level) if level else value, default=None)


def _cell(value: Mapping[str, Any] | float | None, score: str, digits: int, best: float | None, mark: str) -> str:
    """A median with its range, or one number; in percent where it is a coverage, marked where it is the best."""
    if value is None:
        return "–"
    factor, unit = (100.0, " %") if score.startswith("coverage") else (1.0, "")
    spread = value if isinstance(value, Mapping) else {"median": value, "min": value, "max": value, "values": [value]}
    shown = {name: factor * spread[name] for name in ("median", "min", "max")} | {"values": spread["values"]}
    text, median = formatted(shown, digits), number(shown["median"], digits)
    return (f"{mark}{median}{mark}{text.removeprefix(median)}" if spread["median"] == best else text) + unit


def _lost(scores: Scores, model: str, quantity: str) -> str:
    """How many motions had diverged by then."""
    if not quantity.startswith("position"):
        return ""
    moved = [run["motions"] for run in scores.finished(model)]
    at = [each["diverged"][each["horizons"].index(float(quantity.split()[2]))] for each in moved]
    return f", {sum(at)} of {sum(each['motions'] for each in moved)} diverged" if sum(at) else ""


def winner_table(scores: Scores) -> tuple[list[str], list[list[str]]]:
    """Header and rows: by criterion the model to take, and the difference that decides, with its interval."""
    rows = []
    for criterion, each in scores.winners.items():
        pair, sign = each.difference, "−" if criterion == "density" else "/"
        compared = "–" if pair is None else f"{pair.challenger} {sign} {pair.baseline}"
        outcome = "–" if pair is None else pair.outcome
        if pair is not None and pair.favours_challenger and outcome != "better":
            outcome = "better, not sure"
        rows.append([CRITERIA[criterion], each.model, compared, _difference(pair).replace("**", ""), outcome])
    return ["by", "take", "compared", "difference (95 % interval)", "shown"], rows


def _difference(found: PairedDifference | None) -> str:
    if found is None:
        return "–"
    sign = "+" if found.criterion == "density" else ""
    value = f"{found.value:{sign}.3g}"
    value = f"**{value}**" if found.outcome == "better" else value
    if found.interval is None:
        return value
    low, high = found.interval
    return f"{value} ({low:+.3g} to {high:+.3g})" if sign else f"{value} ({low:.3g}–{high:.3g})"


def unit_of(scores: Scores, quantity: str) -> str:
    """`Nm`, or `Nm or N` where joints differ."""
    units = scores.units.get(quantity, "")
    each = [units] if isinstance(units, str) else list(dict.fromkeys(units))
    return " or ".join(each).replace("^2", "²")


def preparation_lines(metadata: Mapping[str, Any]) -> list[str]:
    """`metadata["preparation"]` of a Dataset (`data.Preparation`) as lines, the last step first; delays in s."""
    report = preparation_report(metadata)
    if not report:
        return ["Preparation: none stated; q, v, u and a are scored as the dataset holds them."]
    settings = {each.name: report.get(each.name) for each in fields(Preparation) if each.name != "why"}
    given = ", ".join(f"{name} {value}" for name, value in settings.items() if name == "cutoff" or np.any(value))
    lines = [f"Preparation: {given}."]
    for quantity, reason in dict(report.get("why") or {}).items():
        told = "; ".join(f"{name} {why}" for name, why in reason.items()) if isinstance(reason, Mapping) else reason
        lines.append(f"Chosen automatically, {quantity}: {told}")
    earlier = {"preparation": report.get("earlier")}
    return lines + (preparation_lines(earlier) if preparation_report(earlier) else [])
