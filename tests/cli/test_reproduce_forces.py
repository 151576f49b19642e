"""`forcegp reproduce` of the experiments on force priors, through the real executable, at the smallest size."""

import csv
import json
import shutil

import pytest

EXPERIMENTS = ("data-efficiency", "friction", "transfer", "unilateral-contact", "deep-kernel")
FIGURES = ("data-efficiency", "friction-errors", "friction-curves", "friction-normal-force")


@pytest.fixture(scope="module")
def reproduced(forcegp, tmp_path_factory):
    """The folder of `forcegp reproduce all --preset forces-smoke`."""
    pytest.importorskip("pybullet")
    folder = tmp_path_factory.mktemp("reproduce-forces")
    words = ("reproduce", "all", "--preset", "forces-smoke", "--out", "out", "--docs", "docs", "--jobs", 2)
    done = forcegp(*words, folder=folder, timeout=1200.0)
    assert done.returncode == 0, done.stderr
    assert "force-priors.md tells what was found" in done.stdout
    return folder


def test_all_figures_tables_and_the_page_are_there(reproduced):
    for root in (reproduced / "out", reproduced / "docs"):
        page = (root / "force-priors.md").read_text()
        assert page.startswith("# Force priors: results\n")
        assert not (root / "reproduction.md").exists()
        for name in EXPERIMENTS:
            document = json.loads((root / "force-priors" / f"{name}.json").read_text())
            assert document["preset"] == "forces-smoke"
            with (root / "force-priors" / f"{name}.csv").open() as file:
                rows = list(csv.DictReader(file))
            assert len(rows) == sum(len(trial["tests"]) for trial in document["summary"]["trials"])
            assert all(float(row["mae_median"]) > 0.0 for row in rows)
        for figure in FIGURES:
            assert f"(force-priors/{figure}.png)" in page
            assert (root / "force-priors" / f"{figure}.png").read_bytes().startswith(b"\x89PNG")
            assert (root / "force-priors" / f"{figure}.svg").read_text().startswith("<?xml")
        assert "Its numbers say nothing about the models" in page
        assert "nan" not in page.lower()


def test_components_add_up_and_forces_move_to_other_contacts(reproduced):
    documents = {
        name: json.loads((reproduced / "out" / "force-priors" / f"{name}.json").read_text()) for name in EXPERIMENTS
    }
    sums = [
        scores["component_sum_error"]["max"]
        for trial in documents["friction"]["summary"]["trials"]
        for scores in trial["tests"].values()
    ]
    assert len(sums) > 10
    assert max(sums) < 1e-9
    moved = documents["transfer"]["summary"]["trials"]
    assert {label for trial in moved for label in trial["tests"]} == {"plane", "tilted plane", "sphere", "free motion"}
    bullet = documents["unilateral-contact"]["summary"]
    assert 0.5 < bullet["in_contact_detected"]["median"] < 1.0
    assert all(trial["leave_one_out"] for trial in documents["deep-kernel"]["summary"]["trials"])


def test_a_second_run_computes_nothing_and_changes_no_number(reproduced, forcegp):
    before = (reproduced / "out" / "force-priors.md").read_text()
    cells = {file: file.stat().st_mtime_ns for file in (reproduced / "out" / "cells").glob("**/cell.json")}
    assert len(cells) > 40
    again = forcegp("reproduce", "all", "--preset", "forces-smoke", "--out", "out", "--json", folder=reproduced)
    assert again.returncode == 0, again.stderr
    assert set(json.loads(again.stdout)["figures"]) == set(EXPERIMENTS)
    assert (reproduced / "out" / "force-priors.md").read_text() == before
    assert cells == {file: file.stat().st_mtime_ns for file in (reproduced / "out" / "cells").glob("**/cell.json")}


def test_one_experiment_has_a_page_of_its_own(reproduced, forcegp, tmp_path):
    shutil.copytree(reproduced / "out", tmp_path / "out")
    before = (tmp_path / "out" / "force-priors.md").read_text()
    words = ("reproduce", "data-efficiency", "--preset", "forces-smoke", "--points", 5, "--out", "out", "--jobs", 1)
    done = forcegp(*words, folder=tmp_path, timeout=600.0)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "out" / "data-efficiency.md").read_text()
    assert "    forcegp reproduce data-efficiency --preset forces-smoke --points 5\n" in page
    assert "| tool friction | 5 |" in page
    assert (tmp_path / "out" / "force-priors.md").read_text() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fig2b", "--preset", "forces-smoke"), "no figure 'fig2b'"),
        (("friction",), "no figure 'friction'"),
        (("friction", "--preset", "forces-smoke", "--points", 201, "--out", "new"), "have 200 rows, so give 2 to 200"),
        (("all", "--preset", "forces", "--out", "out"), "holds results of preset 'forces-smoke', not 'forces'"),
    ],
)
def test_refusals_are_one_line_and_leave_everything(reproduced, forcegp, arguments, message):
    before = sorted(reproduced.glob("**/*"))
    refused = forcegp("reproduce", *arguments, folder=reproduced)
    assert refused.returncode == 2
    assert refused.stderr.startswith("forcegp: ")
    assert len(refused.stderr.strip().splitlines()) == 1
    assert message in refused.stderr
    assert sorted(reproduced.glob("**/*")) == before
