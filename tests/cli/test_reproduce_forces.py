"""`forcegp reproduce` of the experiments on force priors, at the smallest size."""

import csv

import pytest
from tests.cli.reproductions import Reproduced

EXPERIMENTS = ("data-efficiency", "friction", "transfer", "unilateral-contact", "deep-kernel")
FIGURES = ("data-efficiency", "friction-errors", "friction-curves", "friction-normal-force")

# minutes of fits; tests/experiments covers the cells, test_executable.py the command
pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def reproduced(installed, tmp_path_factory):
    return Reproduced.everything(installed, tmp_path_factory.mktemp("reproduce-forces"), "forces-smoke", "force-priors")


def test_all_figures_tables_and_the_page_are_there(reproduced):
    for root in reproduced.roots:
        page = reproduced.text(root)
        assert page.startswith("# Force priors: results\n")
        assert not (root / "reproduction.md").exists()
        for name in EXPERIMENTS:
            document = reproduced.document(name, root)
            with (root / "force-priors" / f"{name}.csv").open() as file:
                rows = list(csv.DictReader(file))
            assert len(rows) == sum(len(trial["tests"]) for trial in document["summary"]["trials"])
            assert all(float(row["mae_median"]) > 0.0 for row in rows)
        reproduced.check_pictures(root, FIGURES)
        assert "Its numbers mean nothing for the models" in page
        assert "nan" not in page.lower()


def test_components_add_up_and_forces_move_to_other_contacts(reproduced):
    summaries = {name: reproduced.document(name)["summary"] for name in EXPERIMENTS}
    sums = [
        scores["component_sum_error"]["max"]
        for trial in summaries["friction"]["trials"]
        for scores in trial["tests"].values()
    ]
    assert len(sums) > 10
    assert max(sums) < 1e-9
    moved = summaries["transfer"]["trials"]
    assert {label for trial in moved for label in trial["tests"]} == {"plane", "tilted plane", "sphere", "free motion"}
    assert 0.5 < summaries["unilateral-contact"]["in_contact_detected"]["median"] < 1.0
    assert all(trial["leave_one_out"] for trial in summaries["deep-kernel"]["trials"])


def test_a_second_run_computes_nothing_and_changes_no_number(reproduced):
    reproduced.check_a_second_run_changes_nothing(EXPERIMENTS)


def test_one_experiment_has_a_page_of_its_own(reproduced, tmp_path):
    words = ("--preset", "forces-smoke", "--points", 5)
    page = reproduced.page_of_one("data-efficiency", *words, folder=tmp_path)
    assert "    forcegp reproduce data-efficiency --preset forces-smoke --points 5\n" in page
    assert "| tool friction | 5 |" in page


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("all", "--preset", "forces", "--out", "out"), "results with another preset ('forces-smoke', not 'forces')"),
    ],
)
def test_refusals_are_one_line_and_leave_everything(reproduced, arguments, message):
    reproduced.check_refusal(arguments, message)
