"""`forcegp reproduce`: everything once at the smallest size, and its refusals."""

import csv
import json
import re
import shutil

import pytest
from tests.cli.reproductions import Reproduced

FIGURES = ("fig2b", "fig2c", "fig3", "fig4")

# minutes of fits; tests/benchmarks covers the cells, test_executable.py the command
pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def reproduced(installed, tmp_path_factory):
    return Reproduced.everything(installed, tmp_path_factory.mktemp("reproduce"), "smoke", "reproduction")


def test_all_figures_tables_and_the_page_are_there(reproduced):
    for root in reproduced.roots:
        page = reproduced.text(root)
        for name in FIGURES:
            document = reproduced.document(name, root)
            assert document["config"]["data"]["rows"] == 400
            with (root / "reproduction" / f"{name}.csv").open() as file:
                assert list(csv.DictReader(file))
            reproduced.check_pictures(root, document["figures"])
        assert "Its numbers mean nothing for the models" in page
        assert "nan" not in page.lower().replace("covariance", "")


def test_a_second_run_computes_nothing_and_changes_no_number(reproduced):
    reproduced.check_a_second_run_changes_nothing(FIGURES)


def test_one_figure_has_a_page_of_its_own_that_names_its_command(reproduced, tmp_path):
    page = reproduced.page_of_one("fig3", "--points", 20, folder=tmp_path)
    assert "    forcegp reproduce fig3 --preset smoke --points 20\n" in page


def test_published_values_stand_beside_ours(reproduced):
    rows = reproduced.document("fig2b")["summary"]["curves"]
    assert set(rows) == {"gp", "s-gp-38", "s-gp", "s-gp-mean"}
    assert re.search(r"\| analytical model \| 0\.57 \|", reproduced.text())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("all", "--preset", "paper", "--out", "out"), "holds results with another preset ('smoke', not 'paper')"),
        (("all", "--out", "docs"), "was not written by `forcegp reproduce`"),
        (("all", "--out", "out", "--docs", "docs/reproduction.md"), "cannot be made"),
    ],
)
def test_refusals_are_one_line_and_leave_everything(reproduced, arguments, message):
    reproduced.check_refusal(arguments, message)


def test_a_half_written_job_is_named_and_nothing_is_lost(reproduced, installed, tmp_path):
    shutil.copytree(reproduced.folder / "out", tmp_path / "out")
    file = next((tmp_path / "out" / "jobs" / "fits").glob("**/job.json"))
    whole = file.read_text()
    file.write_text(whole[:100])
    refused = installed("reproduce", "all", "--out", "out", folder=tmp_path)
    assert refused.returncode == 2
    assert str(file.relative_to(tmp_path)) in refused.stderr
    assert "only this job is computed anew" in refused.stderr
    assert file.read_text() == whole[:100]


def test_results_of_other_code_are_computed_anew_with_one_sentence(reproduced, installed, tmp_path):
    shutil.copytree(reproduced.folder / "out", tmp_path / "out")
    for file in (tmp_path / "out" / "jobs" / "fits").glob("analytical/**/job.json"):
        stored = json.loads(file.read_text())
        file.write_text(json.dumps({**stored, "digest": "0", "code": "0", "result": {}}))
    done = installed("reproduce", "all", "--out", "out", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.findall("warning: .* were computed by other code; they are computed anew", done.stderr)
    assert reproduced.text(tmp_path / "out") == reproduced.text()
