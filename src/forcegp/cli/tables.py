"""Tables for people: aligned, with units, readable at 80 columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich import box
from rich.table import Table
from rich.text import Text

import forcegp
import forcegp.evaluation

NONE = "–"
NORMAL_FORCES = "forces along the contact normal rest on the prior alone, since accelerations do not show them"
NORMAL_FORCES_KNOWN = "it follows from the known forces alone"
NORMAL_FORCES_SEEN = "this prior leaves no force along the contact normal free, so accelerations decide it"


def facts(title: str, values: Mapping[str, str]) -> Table:
    """Names and values, one per line."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, show_header=False, pad_edge=False)
    table.add_column(style="dim")
    table.add_column()
    for name, value in values.items():
        table.add_row(name, Text(value))
    return table


def columns(
    title: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    last: Sequence[str] = (),
    long_names: bool = False,
) -> Table:
    """A table whose first column is text and whose others are numbers; `last` is set apart below.

    Texts of the first column are folded where they are `long_names`, all other cells never.
    """
    table = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
    )
    for place, name in enumerate(header):
        folded = long_names and not place
        table.add_column(name, justify="right" if place else "left", no_wrap=not folded, overflow="fold")
    for row in rows:
        table.add_row(*row)
    if last:
        table.add_section()
        table.add_row(*last, style="bold")
    return table


def evaluation_table(title: str, evaluation: forcegp.Evaluation) -> Table:
    """One line per joint and their mean."""
    header = ["joint", "MAE", "noise-\nfree", "RMSE", "NLPD", "in 95 %\nband", "MAE, known\nphysics"]
    formats = {
        "mae": number,
        "mae_noise_free": number,
        "rmse": number,
        "nlpd": nats,
        "coverage_95": percent,
        "known_physics_mae": number,
    }
    rows = []
    for joint, name in enumerate(evaluation.joint_names):
        each = {score: getattr(evaluation, f"{score}_per_joint") for score in formats}
        cells = [show(None if each[score] is None else each[score][joint]) for score, show in formats.items()]
        rows.append([name, *cells])
    means = [show(getattr(evaluation, score)) for score, show in formats.items()]
    return columns(title, header, rows, last=["mean (NLPD: joint)", *means])


def multiplier_scores(evaluation: forcegp.Evaluation) -> str:
    """`MAE 1.2345 N, 90.1 % in the 95 % band`, against the true multipliers."""
    inside = percent(evaluation.multiplier_coverage_95)
    return f"MAE {number(evaluation.multiplier_mae)} N, {inside} in the 95 % band"


def force_facts(scores: forcegp.evaluation.ForceScores, normal_forces: str) -> dict[str, str]:
    """One line per force whose true value is given: its errors relative to its size, and whether the intervals hold.

    `normal_forces` is a remark on what determines the multiplier.
    """
    values = {f"{name}, at the joints": _force_scores(score) for name, score in scores.joint_force.items()}
    values |= {f"{name}, at its point": _force_scores(score) for name, score in scores.point_force.items()}
    if scores.multiplier is not None:
        text = f"MAE {number(scores.multiplier.mae)} N, {_force_scores(scores.multiplier)}; {normal_forces}"
        values["contact force (multiplier)"] = text
    return values


def _force_scores(score: forcegp.evaluation.ForceScore) -> str:
    """`RMS error 2.3 %, 94.1 % in the 95 % band`; the error in Nm or N where there is no force."""
    if score.relative_rmse is None:
        error = f"{number(score.rmse)} (the true force is zero)"
    else:
        share = 100.0 * score.relative_rmse
        error = f"{share:.2g} %" if share < 99.5 else f"{share:.0f} %"
    return f"RMS error {error}, {percent(score.coverage_95)} in the 95 % band"


def number(value: float | None) -> str:
    """Four decimals for numbers of ordinary size, a power of ten for others, a dash for none."""
    if value is None:
        return NONE
    return f"{value:.4f}" if value == 0 or 1e-3 <= abs(value) < 1e4 else f"{value:.0e}"


def nats(value: float | None) -> str:
    """Two decimals: differences below a hundredth of a nat are not significant."""
    return NONE if value is None else f"{value:.2f}"


def percent(value: float | None) -> str:
    """`94.6 %`."""
    return NONE if value is None else f"{100.0 * value:.1f} %"
