"""`python -m benchmarks.paper`: everything once at the smallest size, and what it refuses before it computes."""

import json
import re
from pathlib import Path

import pytest
from benchmarks.paper.__main__ import main

from forcegp.cli.main import main as forcegp

FIGURES = ("fig2b", "fig2c", "fig3", "fig4")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("fig9", "no figure 'fig9'"),
        ("fig2b --preset huge", "no preset 'huge'"),
        ("fig2b --jobs 0", "jobs is 0; give the number of tasks at once"),
        ("fig2b --points 500", "its data have 400 rows, so give 2 to 400"),
        ("fig2b --points 1", "asked for 1 training points"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, capfd, words, message):
    monkeypatch.chdir(tmp_path)
    assert main([*words.split(), "--out", "new"]) == 2
    told = capfd.readouterr()
    assert (told.out, told.err.count("\n")) == ("", 1)
    assert message in told.err
    assert not list(tmp_path.iterdir())


@pytest.mark.nightly  # minutes of fits; the other tests here cover the pieces
def test_all_figures_are_there_and_a_second_run_changes_nothing(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    words = ["all", "--out", "out", "--docs", "docs", "--jobs", "2"]
    assert main(words) == 0, capfd.readouterr().err
    page = (tmp_path / "docs" / "reproduction.md").read_text()
    assert "Its numbers mean nothing for the models" in page
    assert re.search(r"\| analytical model \| 0\.57 \|", page)
    for name in FIGURES:
        document = json.loads((tmp_path / "docs" / "reproduction" / f"{name}.json").read_text())
        assert document["config"]["data"]["rows"] == 400
        for figure in document["figures"]:
            assert f"(reproduction/{figure}.png)" in page
            assert (tmp_path / "docs" / "reproduction" / f"{figure}.png").read_bytes().startswith(b"\x89PNG")
    kept = {file: file.stat().st_mtime_ns for file in (tmp_path / "out" / "jobs").glob("**/job.json")}
    capfd.readouterr()
    assert main([*words, "--json"]) == 0
    assert set(json.loads(capfd.readouterr().out)["figures"]) == set(FIGURES)
    assert {file: file.stat().st_mtime_ns for file in kept} == kept
    assert main(["all", "--preset", "paper", "--out", "out"]) == 2
    assert "holds results with another preset" in capfd.readouterr().err


def test_forcegp_reproduce_is_the_same(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    for words, message in (("fig9", "no figure 'fig9'"), ("fig2b --preset huge", "no preset 'huge'")):
        assert forcegp(["reproduce", *words.split(), "--out", "new"]) == 2
        assert message in capfd.readouterr().err
    monkeypatch.setattr("forcegp.cli.simulated.EXPERIMENTS", Path("nowhere.py"))
    assert forcegp(["reproduce", "all"]) == 2
    assert "git clone" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())
