"""Tables of scores against numbers that were put into them by hand."""

import pytest

from forcegp.scores import Scores, model_table, overall
from forcegp.scores.accuracy import median_and_range
from forcegp.scores.page import columns_of, formatted, markdown_table, number, page, preparation_lines

UNITS = {"q": "rad", "v": "rad/s", "u": ("Nm", "N"), "a": "rad/s^2"}


def run(seed: int, factor: float, diverged: int = 0, error: str | None = None) -> dict:
    """Of two joints, whose errors are as large as the factor says."""
    found = {"split": "s", "seed": seed, "error": error, "warnings": [f"warning {seed}"], "cpu_seconds": 1.0}
    if error is not None:
        return found
    of_joints = {"mae": [0.1, 0.3], "rmse": [0.2, 0.4], "nrmse": [0.02, 0.04], "known_physics_mae": [1.0, 2.0]}
    acceleration = {name: [factor * x for x in each] for name, each in of_joints.items()}
    acceleration |= {"nlpd": [1.0 * factor, 2.0 * factor], "coverage_95": [0.9, 1.0], "coverage_50": [0.4, 0.7]}
    table = {
        "acceleration": acceleration, "all joints": {"nlpd": [5.0 * factor]},
        "force": {"mae": [3.0, 5.0], "rmse": [3.0 * factor, 4.0 * factor]},
        "contact force": {"mae": [7.0], "rmse": [8.0], "relative_rmse": [0.125], "coverage_95": [None]},
        "position after 0.5 s": {"rmse": [3e-6 * factor, 4e-6 * factor]},
    }  # fmt: skip
    squared = [[(1e-5 * factor) ** 2, (2e-5 * factor) ** 2]]
    motions = {"horizons": [0.5], "motions": 2, "diverged": [diverged], "squared": squared}
    return found | {"table": table, "motions": motions, "stretches": [factor**2, 1.1 * factor**2]}


@pytest.fixture(scope="module")
def scores() -> Scores:
    models = {
        "urdf": {"kind": "given", "summary": "as given"},
        "ls": {"kind": "identified", "summary": "identified"},
        "gp": {"kind": "force prior", "summary": "learned"},
    }
    runs = {
        "urdf": [run(0, 4.0), run(1, 4.0), run(2, 4.0)],
        "ls": [run(0, 2.0), run(1, 2.2), run(2, 2.4, diverged=1)],
        "gp": [run(0, 0.5), run(1, 0.0, error="no luck"), run(2, 0.6)],
    }
    about = {"rows": 100, "seeds": [0, 1, 2], "machine": "here", "forcegp": "0", "notes": ["<b>x</b> a&lt;b < 2 & c"]}
    return Scores(models=models, runs=runs, joint_names=("a", "b"), units=UNITS, about=about)


def test_one_model_by_joint_and_by_quantity(scores):
    alone = Scores(models={"gp": scores.models["gp"]}, runs={"gp": [run(0, 0.5)]}, joint_names=("a", "b"), units=UNITS)
    assert model_table(alone) == (
        ["", "MAE", "RMSE", "RMSE / size", "NLPD", "in 95 %", "known physics"],
        [
            ["a", "0.0500", "0.1000", "–", "0.50", "90.0 %", "0.5000"],
            ["b", "0.1500", "0.2000", "–", "1.00", "100.0 %", "1.0000"],
            ["acceleration", "0.1000", "0.1500", "–", "0.75", "95.0 %", "0.7500"],
            ["all joints", "–", "–", "–", "2.50", "–", "–"],
            ["force", "4.0000", "1.7678", "–", "–", "–", "–"],  # the root of the mean of squares
            ["contact force", "7.0000", "8.0000", "0.125", "–", "–", "–"],
            ["position after 0.5 s", "–", "1.8e-06", "–", "–", "–", "–"],
        ],
    )


def test_models_side_by_side(scores):
    header, rows = overall(scores)
    assert header == [
        "model", "MAE [rad/s²]", "nRMSE", "force error [Nm or N]", "NLPD [nats]", "in 95 %", "in 50 %",
        "q after 0.5 s [rad]",
    ]  # fmt: skip
    urdf, ls, gp = rows
    assert urdf[:2] == ["urdf", "0.8000"]
    assert ls[1:3] == ["0.4400 (0.4000–0.4800)", "0.066 (0.060–0.072)"]
    assert ls[-1].endswith(", 1 of 6 diverged")
    assert gp[0] == "gp (2 of 3 runs)"
    assert gp[1] == "0.1100 (0.1000–0.1200)"
    assert gp[4] == "2.75 (2.50–3.00)"
    assert [row[5] for row in rows] == ["95.0 %"] * 3


def test_the_page_holds_all_of_it(scores):
    text = page(scores)
    assert "\n* &lt;b>x&lt;/b> a&amp;lt;b < 2 & c\n" in text
    assert "| ls | 0.4400 (0.4000–0.4800) |" in text
    assert "gp failed in 1 of 3 runs (s, seed 1): no luck" in text
    assert "| gp | 1.650 | 2.200 |" in text
    assert len(columns_of(scores)) == 7
    assert f"**gp**: {scores.winner.sentence}" in text


def test_what_was_done_with_a_log_is_told_the_last_step_first():
    earlier = {"cutoff": 20.0, "every": 1, "earlier": None, "rows": [9, 8], "why": {}}
    last = {"cutoff": None, "every": 4, "delay": [0.0], "rows": [8, 2], "why": {"every": "x"}, "earlier": earlier}
    lines = preparation_lines({"preparation": last})
    assert lines == ["Preparation: cutoff None, every 4.", "Preparation: cutoff 20.0, every 1."]
    assert preparation_lines({})[0].startswith("Preparation: none stated")


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(None, 4, "–"), (0.0831, 4, "0.0831"), (5e-5, 4, "5.0e-05"), (6e-4, 4, "0.0006"), (1e4, 3, "1.0e+04"),
     (9999.0, 3, "9999.000"), (12345.0, 1, "12345.0"), (0.0, 4, "0.0000"), (-2e-5, 4, "-2.0e-05")],
)  # fmt: skip
def test_numbers_as_text(value, digits, text):
    assert number(value, digits) == text == formatted(value, digits)


def test_spreads_and_tables():
    assert median_and_range([3.0, 1.0, 2.0]) == {"median": 2.0, "min": 1.0, "max": 3.0, "values": [3.0, 1.0, 2.0]}
    assert median_and_range([1.0, None]) is None
    assert formatted(median_and_range([0.1, 0.3, 0.2]), 2) == "0.20 (0.10–0.30)"
    assert formatted(median_and_range([0.5])) == "0.5000"
    assert formatted(None) == "–"
    assert [number(value) for value in (0.0, 1.2e-9, 0.08311, 23456.7)] == ["0.0000", "1.2e-09", "0.0831", "2.3e+04"]
    assert markdown_table(["a", "b"], [["x", "1"]]) == "| a | b |\n|---|---:|\n| x | 1 |"
