"""The page of scores in Markdown, and the same tables as rows of text for terminals and reports."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from forcegp.data import Preparation, preparation_report
from forcegp.scores.accuracy import ACCELERATION, ALL_JOINTS, AT_SENSOR, FORCE
from forcegp.scores.scores import MARGIN, Scores


def formatted(value: Mapping[str, Any] | float | None, digits: int = 4) -> str:
    """`.0831 (.0825–.0847)` of a median with its range, `.0831` where that is one number, a dash of nothing."""
    if not isinstance(value, Mapping):
        return number(value, digits)
    middle, low, high = (number(value[name], digits) for name in ("median", "min", "max"))
    return middle if low == high else f"{middle} ({low}–{high})"


def number(value: float | None, digits: int = 4) -> str:
    """With that many decimals; where three or more are asked for, very small and very large ones as a power of ten."""
    if value is None:
        return "–"
    if digits < 3 or value == 0 or 10.0**-digits * 5 <= abs(value) < 1e4:
        return f"{value:.{digits}f}"
    return f"{value:.1e}"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """First column left, the others right."""
    lines = [f"| {' | '.join(header)} |", f"|---|{'---:|' * (len(header) - 1)}"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def rendered(template: Path, **values: Any) -> str:
    """The text of a template, with the filters `formatted`, `number` and `table`; one blank line between paragraphs."""
    from jinja2 import Environment, StrictUndefined

    def plain(value: Any) -> Any:  # names of joints and files may hold HTML
        return HTML.sub(lambda found: escape(found[0]), value) if isinstance(value, str) else value

    pages = Environment(undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, finalize=plain)
    pages.filters |= {"formatted": formatted, "number": number, "table": lambda rows, head: markdown_table(head, rows)}
    text = pages.from_string(template.read_text(encoding="utf-8"))
    return re.sub(r"\n{3,}", "\n\n", text.render(values)).strip() + "\n"


HTML = re.compile(r"<(?=[A-Za-z/!?])|&(?=#?\w+;)")
Column = tuple[str, str, str, int]  # title, quantity, score and decimals; of a coverage in percent


def page(scores: Scores) -> str:
    """Markdown: what was done, the model to take, tables, and what failed."""
    finished, by_joint = [name for name in scores.models if scores.finished(name)], []
    for title, quantity, score, digits in columns_of(scores) if finished else ():
        of = ACCELERATION if quantity == ALL_JOINTS else quantity  # densities of each joint alone
        each = {name: scores.columns(score, of, name) for name in finished}
        if all(len(numbers) == len(scores.joint_names) for numbers in each.values()):
            rows = [[name, *(_cell(x, score, digits) for x in numbers)] for name, numbers in each.items()]
            by_joint.append((title, markdown_table(["model", *scores.joint_names], rows)))
    notes = [*scores.about.get("notes", ()), *(each for x in scores.about.get("splits", ()) for each in x["notes"])]
    return rendered(
        Path(__file__).with_name("report.md.jinja"),
        **{"source": {}, "preparation": [], "splits": [], "configuration": {}, **scores.about, "notes": notes},
        margin=MARGIN,
        winner=scores.winner,
        overall=markdown_table(*overall(scores)) if finished else "",
        by_joint=by_joint,
        listed=[[name, each["kind"], each["summary"], str(len(scores.finished(name)))]
                for name, each in scores.models.items()],
        failures=scores.failures,
        warnings=scores.warnings,
    )  # fmt: skip


OF_ONE = (
    ("MAE", "mae", 4),
    ("RMSE", "rmse", 4),
    ("RMSE / size", "relative_rmse", 3),
    ("NLPD", "nlpd", 2),
    ("in 95 %", "coverage_95", 1),
    ("known physics", "known_physics_mae", 4),
)


def model_table(scores: Scores, model: str | None = None) -> tuple[list[str], list[list[str]]]:
    """Header and rows of one model: accelerations by joint, then every quantity over all of its columns."""
    held, titles, names = scores.quantities(model), ["", *(title for title, *_ in OF_ONE)], scores.joint_names
    own = {score: scores.columns(score, ACCELERATION, model) for _, score, _ in OF_ONE if score in held[ACCELERATION]}
    each = {
        name: {score: column[place] for score, column in own.items() if len(column) == len(names)}
        for place, name in enumerate(names)
    }
    for quantity, known in held.items():
        each[quantity] = {score: scores.value(score, quantity, model) for _, score, _ in OF_ONE if score in known}
    rows = [[name, *(_cell(row.get(score), score, n) for _, score, n in OF_ONE)] for name, row in each.items() if row]
    return titles, rows


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
    sensed = [name for name in (held[0] if held else ()) if name.startswith(AT_SENSOR)]
    wanted += [(f"{name} [N]", name, "rmse", 2) for name in sensed]
    return [each for each in wanted if all(each[2] in other.get(each[1], ()) for other in held)]


def overall(scores: Scores) -> tuple[list[str], list[list[str]]]:
    """Header and one row per model, all joints together: medians over runs, with their range."""
    columns, rows = columns_of(scores), []
    for name, runs in scores.runs.items():
        count = len(scores.finished(name))
        row = [name if count == len(runs) else f"{name} ({count} of {len(runs)} runs)"]
        for _, quantity, score, digits in columns if count else ():
            row.append(_cell(scores.spread(score, quantity, name), score, digits) + _lost(scores, name, quantity))
        rows.append(row + ["–"] * (1 + len(columns) - len(row)))
    return ["model", *(title for title, *_ in columns)], rows


def _cell(value: Mapping[str, Any] | float | None, score: str, digits: int) -> str:
    if value is None or not score.startswith("coverage"):
        return formatted(value, digits)
    if isinstance(value, Mapping):
        return formatted({name: 100.0 * value[name] for name in ("median", "min", "max")}, digits) + " %"
    return f"{number(100.0 * value, digits)} %"


def _lost(scores: Scores, model: str, quantity: str) -> str:  # motions that had diverged by then
    if not quantity.startswith("position"):
        return ""
    moved = [run["motions"] for run in scores.finished(model)]
    at = [each["diverged"][each["horizons"].index(float(quantity.split()[2]))] for each in moved]
    return f", {sum(at)} of {sum(each['motions'] for each in moved)} diverged" if sum(at) else ""


def unit_of(scores: Scores, quantity: str) -> str:
    """`Nm`, or `Nm or N` where joints differ."""
    units = scores.units.get(quantity, "")
    return " or ".join([units] if isinstance(units, str) else list(dict.fromkeys(units))).replace("^2", "²")


def preparation_lines(metadata: Mapping[str, Any]) -> list[str]:
    """`metadata["preparation"]` of a Dataset (`data.Preparation`) as lines, the last step first; delays in s."""
    report = preparation_report(metadata)
    if not report:
        return ["Preparation: none stated; q, v, u and a are scored as the dataset holds them."]
    settings = {each.name: report.get(each.name) for each in fields(Preparation) if each.name != "why"}
    given = ", ".join(f"{name} {value}" for name, value in settings.items() if name == "cutoff" or np.any(value))
    earlier = {"preparation": report.get("earlier")}
    return [f"Preparation: {given}.", *(preparation_lines(earlier) if preparation_report(earlier) else [])]
